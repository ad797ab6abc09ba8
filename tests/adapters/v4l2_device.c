/* A camera for the V4L2 code of the process that this is loaded into (LD_PRELOAD): a path is a device.
 *
 * V4L2_DEVICE      the path; the camera is plugged in while a file is there.
 * V4L2_DEVICE.MJPG, .YUYV    what a frame of that format holds, read anew for each.
 * V4L2_DEVICE.silent         while it is there no frame comes.
 * V4L2_CLOCK       of its stamps: "monotonic", or "realtime". V4L2_SOURCE: "soe" or "eof".
 * Frames are 64x48 or 128x96, 30 a second at most. Stamps are whole milliseconds, a period apart, and 20 ms older than
 * the moment at which their frame is there.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define MOST 10
#define BYTES (1 << 20)
#define AGE_MS 20

static int ours[1024];
static struct { void *memory; int queued; } buffers[MOST];
static unsigned int count, streaming, next;
static long long started_ms, frames;
static unsigned int width = 64, height = 48, format = V4L2_PIX_FMT_YUYV, fps = 30;
static int automatic = V4L2_EXPOSURE_APERTURE_PRIORITY, exposure = 156, gain = 10, priority = 1;
static const unsigned int formats[] = {V4L2_PIX_FMT_MJPEG, V4L2_PIX_FMT_YUYV};

static int fail(int error) { errno = error; return -1; }

static const char *device(void) { const char *path = getenv("V4L2_DEVICE"); return path ? path : ""; }

static int is(const char *name, const char *value) {
    const char *set = getenv(name);
    return set && strcmp(set, value) == 0;
}

static int beside(char *path, size_t size, const char *suffix) { return snprintf(path, size, "%s.%s", device(), suffix); }

static int open_path(const char *path, int flags, mode_t mode) {
    if (strcmp(path, device()) != 0 || access(path, F_OK) != 0)
        return (int)syscall(SYS_openat, AT_FDCWD, path, flags, mode);
    /* It can be selected on, and is readable when a frame is due. */
    int fd = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    if (fd >= 0 && fd < 1024) ours[fd] = 1;
    return fd;
}

#define OPEN(name)                                         \
    int name(const char *path, int flags, ...) {           \
        va_list more;                                      \
        va_start(more, flags);                             \
        mode_t mode = (flags & O_CREAT) ? va_arg(more, mode_t) : 0; \
        va_end(more);                                      \
        return open_path(path, flags, mode);               \
    }
OPEN(open)
OPEN(open64)
OPEN(__open_2)
OPEN(__open64_2)

int close(int fd) {
    if (fd >= 0 && fd < 1024) ours[fd] = 0;
    return (int)syscall(SYS_close, fd);
}

void *mmap64(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
    if (fd < 0 || fd >= 1024 || !ours[fd])
        return (void *)syscall(SYS_mmap, at, length, protection, flags, fd, offset);
    void *memory = (void *)syscall(SYS_mmap, at, length, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    buffers[offset / BYTES].memory = memory;
    return memory;
}

void *mmap(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
    return mmap64(at, length, protection, flags, fd, offset);
}

static long long now_ms(void) {
    struct timespec now;
    clock_gettime(is("V4L2_CLOCK", "realtime") ? CLOCK_REALTIME : CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000LL + now.tv_nsec / 1000000;
}

static int pace(int fd, int on) {
    started_ms = now_ms();
    frames = 0;
    long period = on ? 1000000000L / fps : 0;
    struct itimerspec often = {{0, period}, {0, period}};
    streaming = on;
    return timerfd_settime(fd, 0, &often, NULL);
}

static void fill(struct v4l2_buffer *buffer) {
    char path[4096], name[5] = {0};
    memcpy(name, &format, 4);
    beside(path, sizeof path, name);
    FILE *file = fopen(path, "rb");
    buffer->bytesused = file ? (unsigned int)fread(buffers[buffer->index].memory, 1, BYTES, file) : 0;
    if (file) fclose(file);
    long long ms = started_ms + frames * 1000 / fps - AGE_MS;
    buffer->timestamp.tv_sec = ms / 1000;
    buffer->timestamp.tv_usec = ms % 1000 * 1000;
    buffer->sequence = (unsigned int)frames;
}

static void describe(struct v4l2_buffer *buffer) {
    buffer->length = BYTES;
    buffer->m.offset = buffer->index * BYTES;
    buffer->flags = is("V4L2_CLOCK", "realtime") ? 0 : V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    if (is("V4L2_SOURCE", "soe")) buffer->flags |= V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
}

static int dequeue(int fd, struct v4l2_buffer *buffer) {
    char path[4096];
    uint64_t due;
    beside(path, sizeof path, "silent");
    if (access(path, F_OK) == 0) pace(fd, 0);
    if (read(fd, &due, sizeof due) != sizeof due) return fail(EAGAIN);
    frames += (long long)due;
    for (unsigned int i = 0; i < count; i++) {
        unsigned int index = (next + i) % count;
        if (!buffers[index].queued) continue;
        buffers[index].queued = 0;
        next = index + 1;
        buffer->index = index;
        describe(buffer);
        fill(buffer);
        return 0;
    }
    return fail(EAGAIN); /* no buffer: the frame is lost */
}

static int *control(unsigned int id, int *low, int *high) {
    *low = 0;
    switch (id) {
    case V4L2_CID_EXPOSURE_AUTO: *high = 3; return &automatic;
    case V4L2_CID_EXPOSURE_ABSOLUTE: *low = 1; *high = 330; return &exposure;
    case V4L2_CID_EXPOSURE_AUTO_PRIORITY: *high = 1; return &priority;
    case V4L2_CID_GAIN: *high = 100; return &gain;
    default: return NULL;
    }
}

static int set_format(struct v4l2_format *wanted) {
    if (streaming || count) return fail(EBUSY);
    unsigned int known = 0;
    for (unsigned int i = 0; i < 2; i++) known |= wanted->fmt.pix.pixelformat == formats[i];
    if (known) format = wanted->fmt.pix.pixelformat;
    width = wanted->fmt.pix.width > 96 ? 128 : 64;
    height = width * 3 / 4;
    return 0;
}

static void tell_format(struct v4l2_format *told) {
    told->fmt.pix.width = width;
    told->fmt.pix.height = height;
    told->fmt.pix.pixelformat = format;
    told->fmt.pix.field = V4L2_FIELD_NONE;
    told->fmt.pix.bytesperline = 2 * width;
    told->fmt.pix.sizeimage = BYTES;
}

static int answer(int fd, unsigned int request, void *argument) {
    int low, high, *value;
    if (access(device(), F_OK) != 0) {
        streaming = count = 0; /* what is plugged in later is another one */
        return fail(ENODEV);
    }
    switch (request) {
    case VIDIOC_QUERYCAP: {
        struct v4l2_capability *told = argument;
        memset(told, 0, sizeof *told);
        strcpy((char *)told->driver, "made");
        strcpy((char *)told->card, "Made-up camera");
        told->capabilities = told->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        return 0;
    }
    case VIDIOC_ENUM_FMT: {
        struct v4l2_fmtdesc *told = argument;
        if (told->index >= 2) return fail(EINVAL);
        told->pixelformat = formats[told->index];
        return 0;
    }
    case VIDIOC_S_FMT:
        if (set_format(argument) != 0) return -1;
        tell_format(argument);
        return 0;
    case VIDIOC_G_FMT:
        tell_format(argument);
        return 0;
    case VIDIOC_S_PARM: {
        struct v4l2_fract *period = &((struct v4l2_streamparm *)argument)->parm.capture.timeperframe;
        if (period->numerator && period->denominator) fps = period->denominator / period->numerator;
        if (fps < 1 || fps > 30) fps = 30;
    } /* fall through */
    case VIDIOC_G_PARM: {
        struct v4l2_fract *period = &((struct v4l2_streamparm *)argument)->parm.capture.timeperframe;
        period->numerator = 1;
        period->denominator = fps;
        return 0;
    }
    case VIDIOC_QUERYCTRL: {
        struct v4l2_queryctrl *told = argument;
        if (!control(told->id, &low, &high)) return fail(EINVAL);
        told->minimum = low;
        told->maximum = high;
        return 0;
    }
    case VIDIOC_G_CTRL: {
        struct v4l2_control *told = argument;
        if (!(value = control(told->id, &low, &high))) return fail(EINVAL);
        told->value = *value;
        return 0;
    }
    case VIDIOC_S_CTRL: {
        struct v4l2_control *wanted = argument;
        if (!(value = control(wanted->id, &low, &high))) return fail(EINVAL);
        if (wanted->value < low || wanted->value > high) return fail(ERANGE);
        if (value == &exposure && automatic != V4L2_EXPOSURE_MANUAL) return fail(EACCES);
        if (value == &automatic && wanted->value == V4L2_EXPOSURE_AUTO) return fail(EINVAL);
        *value = wanted->value;
        return 0;
    }
    case VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *wanted = argument;
        if (streaming) return fail(EBUSY);
        count = wanted->count > MOST ? MOST : wanted->count;
        memset(buffers, 0, sizeof buffers);
        wanted->count = count;
        next = 0;
        return 0;
    }
    case VIDIOC_QUERYBUF: {
        struct v4l2_buffer *told = argument;
        if (told->index >= count) return fail(EINVAL);
        describe(told);
        return 0;
    }
    case VIDIOC_QBUF:
        buffers[((struct v4l2_buffer *)argument)->index].queued = 1;
        return 0;
    case VIDIOC_DQBUF:
        return dequeue(fd, argument);
    case VIDIOC_STREAMON:
        return pace(fd, 1);
    case VIDIOC_STREAMOFF:
        return pace(fd, 0);
    default:
        return fail(ENOTTY);
    }
}

int ioctl(int fd, unsigned long request, ...) {
    va_list more;
    va_start(more, request);
    void *argument = va_arg(more, void *);
    va_end(more);
    if (fd < 0 || fd >= 1024 || !ours[fd]) return (int)syscall(SYS_ioctl, fd, request, argument);
    return answer(fd, (unsigned int)request, argument);
}
