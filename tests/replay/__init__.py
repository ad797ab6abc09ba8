"""Recorded and rendered frames through the whole pipeline, against goldens and the true poses.

A package, so that other folders' tests can import `replay.rendered`.
"""
