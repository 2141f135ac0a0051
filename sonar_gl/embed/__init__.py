"""A sonar inside a program that renders its own world: pings of its depth images, textures and drawing."""

from sonar_gl.embed.sensor import Sensor, glsl, ping_from_depth
from sonar_gl.embed.textures import metres_ahead

__all__ = ["Sensor", "glsl", "metres_ahead", "ping_from_depth"]
