"""Samples to beams and range bins."""
