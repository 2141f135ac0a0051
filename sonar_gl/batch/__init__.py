"""Headless batches: a job file, and what makes data sets of it."""
