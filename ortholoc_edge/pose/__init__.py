"""Pixel pairs in, a pose with an honest covariance out."""
