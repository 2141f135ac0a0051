"""Headless batches of many pings."""
