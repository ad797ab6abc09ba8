"""The orientation field as an ONNX graph against OpenCV: ``python docs/studies/structural_onnx.py``.

Prints the median CPU time of both for a 512 x 384 px picture, and how far they differ.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from ortholoc_edge.matching import orientation


def graph() -> bytes:
    """Sobel, double angle, blurs: `orientation.orientation_field` without a mask, before the local mean goes."""
    sobel = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]], np.float32)
    gauss = cv2.getGaussianKernel(7, orientation._SMOOTHING_PX).astype(np.float32)
    box = np.full((1, 1, orientation._WINDOW_PX, 1), 1.0 / orientation._WINDOW_PX, np.float32)
    tensors = {
        "sobel": np.stack([sobel, sobel.T])[:, None],
        "gauss_v": np.repeat(gauss.reshape(1, 1, 7, 1), 2, axis=0),
        "gauss_h": np.repeat(gauss.reshape(1, 1, 1, 7), 2, axis=0),
        "box_v": box,
        "box_h": box.reshape(1, 1, 1, -1),
        "tiny": np.array(1e-3, np.float32),
        "two": np.array(2.0, np.float32),
        "noise": np.array(orientation._NOISE, np.float32),
    }
    nodes: list[onnx.NodeProto] = []

    def add(op: str, inputs: list[str], output: str, **attributes: object) -> str:
        nodes.append(helper.make_node(op, inputs, [output], **attributes))
        return output

    half = orientation._WINDOW_PX // 2
    add("Conv", ["image", "sobel"], "xy", pads=[1, 1, 1, 1])
    add("Split", ["xy"], "x", axis=1, num_outputs=2)
    nodes[-1].output.append("y")
    add("Mul", ["x", "x"], "xx"), add("Mul", ["y", "y"], "yy"), add("Mul", ["x", "y"], "cross")
    add("Add", ["xx", "yy"], "sum"), add("Sqrt", ["sum"], "strength"), add("Max", ["strength", "tiny"], "safe")
    add("Sub", ["xx", "yy"], "real"), add("Mul", ["cross", "two"], "imaginary")
    add("Concat", ["real", "imaginary"], "both", axis=1), add("Div", ["both", "safe"], "field")
    add("Conv", ["field", "gauss_v"], "g1", group=2, pads=[3, 0, 3, 0])
    add("Conv", ["g1", "gauss_h"], "g2", group=2, pads=[0, 3, 0, 3])
    last = "strength"
    for k in range(2):
        last = add("Conv", [last, "box_v"], f"v{k}", pads=[half, 0, half, 0])
        last = add("Conv", [last, "box_h"], f"h{k}", pads=[0, half, 0, half])
    add("Add", [last, "noise"], "around"), add("Div", ["g2", "around"], "out")
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, "h", "w"])
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 2, "h", "w"])
    weights = [numpy_helper.from_array(value, name) for name, value in tensors.items()]
    model = helper.make_model(
        helper.make_graph(nodes, "field", [image], [out], weights), opset_imports=[helper.make_opsetid("", 18)]
    )
    model.ir_version = 9
    onnx.checker.check_model(model)
    return model.SerializeToString()


def cpu_ms(call: Callable[[], object], rounds: int = 60) -> float:
    spent = []
    for _ in range(rounds):
        start = time.process_time()
        call()
        spent.append((time.process_time() - start) * 1e3)
    return float(np.median(spent))


def main() -> None:
    cv2.setNumThreads(1)
    noise = np.random.default_rng(0).normal(size=(384, 512)).astype(np.float32)
    image = np.clip(cv2.GaussianBlur(noise, (0, 0), 2.0) * 400 + 128, 0, 255).astype(np.uint8)
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = ort.InferenceSession(graph(), options, providers=["CPUExecutionProvider"])
    subtract, orientation._subtract_local_mean = orientation._subtract_local_mean, lambda field, inner: None
    try:
        ours = orientation.orientation_field(image)
        theirs = session.run(None, {"image": image.astype(np.float32)[None, None]})[0][0]
        inner = (slice(None), slice(16, -16), slice(16, -16))  # borders are mirrored here, zero there
        print(f"largest difference {np.abs(ours - theirs)[inner].max():.1e} of {np.abs(ours).max():.1f}")
        print(f"OpenCV {cpu_ms(lambda: orientation.orientation_field(image)):.2f} ms")
        print(f"ONNX Runtime {cpu_ms(lambda: session.run(None, {'image': image.astype(np.float32)[None, None]})):.2f} ms")
    finally:
        orientation._subtract_local_mean = subtract


if __name__ == "__main__":
    main()
