"""What a camera is: files that say it, and how to find it from pictures of a board or from a flight."""
