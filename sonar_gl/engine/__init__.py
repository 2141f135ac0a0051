"""One ping and many: pipeline, adaptive sampling, world, multipath."""
