"""Samples as G-buffers: range, direction, normal, echo and body of each."""

from __future__ import annotations

import numpy as np

from sonar_gl.acoustics.boundary import plane_of
from sonar_gl.ping import GBuffer
from sonar_gl.sonar.samples import ViewSamples


def gbuffers_of(view: ViewSamples) -> list[GBuffer]:
    """Return samples that were drawn with bodies as one `GBuffer` a sector."""
    out = []
    for sector, plane_echo, body_id, _ in view.sectors:
        u, v = sector.sample_coordinates()
        q, slopes = np.split(plane_echo[..., :3].astype(np.float64), [1], axis=-1)
        q = q[..., 0]
        plane = plane_of(q, slopes, np.stack([u, v], axis=-1))
        hit = q > 0
        length = np.where(hit, np.linalg.norm(plane, axis=-1), 1.0)
        normal = -(plane / length[..., None]) @ sector.rotation()
        ray = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation()
        ray_length = np.sqrt(1 + u * u + v * v)
        range_m = np.where(hit, ray_length / np.where(hit, q, 1.0), 0.0)
        out.append(
            GBuffer(
                range_m=range_m.astype(np.float32),
                direction=(ray / ray_length[..., None]).astype(np.float32),
                normal=np.where(hit[..., None], normal, 0).astype(np.float32),
                echo=np.where(hit, plane_echo[..., 3] / np.where(hit, range_m, 1), 0).astype(np.float32),
                body_id=np.where(hit, body_id, 0),  # OpenGL leaves open whether integers are cleared
            )
        )
    return out
