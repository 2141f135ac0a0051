"""Other ways to make a ping, each tuned as well as ours: what the chart compares.

Each is made once from (scene, sonar, acoustics, pose, rung), with the scene in place and its directions laid
out; then `ping(pose)` gives (B, K) float32 intensity before noise. All form beams as ours does, from columns
that end where beams do, and share the work between two threads. A rung is (samples to a beam spacing, rows).
"""
