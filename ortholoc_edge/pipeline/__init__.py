"""What happens to one frame: prior, region, precondition, match, lift, pose, AdHoP, gate. No threads, no sockets."""
