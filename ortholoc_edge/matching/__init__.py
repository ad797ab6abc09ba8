"""Two images in, pixel pairs out."""
