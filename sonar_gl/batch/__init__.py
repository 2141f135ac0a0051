"""Batches of pings: data sets made without a window, by many processes or machines."""
