"""Recorded sequences, truth, metrics and reports."""
