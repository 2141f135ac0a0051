"""Other ways to make a ping, each tuned as well as ours: the methods that the chart compares.

A rival is made from (scene, sonar, acoustics, pose, resolution) and prepares the scene and its directions;
`ping(pose)` then returns (B, K) float32 intensity without noise. All form beams as ours does, from columns
that end where beams do, and share the work between two threads. A resolution is a pair: samples a beam
spacing, rows.
"""
