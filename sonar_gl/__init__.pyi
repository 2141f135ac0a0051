"""Public names of sonar_gl: this file is both what type checkers read and what `__init__.py` loads lazily."""

from . import embed
from .acoustics.acoustics import Acoustics
from .acoustics.water import Water
from .analysis.reference import reference_ping
from .analysis.terms import needed_acoustics
from .core.errors import Error
from .core.poses import pose
from .embed.camera import Camera
from .embed.sensor import ping_from_depth
from .imaging.axes import draw_axes
from .imaging.demarco2015 import demarco_image
from .imaging.fan_image import colorize, fan_image
from .imaging.files import load_npz, save_animation, save_npz, save_png
from .live.viewer import view
from .noise.settings import Noise
from .ping import GBuffer, Ping
from .scene.load import bundled_scenes, load_scene
from .scene.mujoco_model import mujoco_poses, mujoco_sonar_pose
from .scene.plume import Bubbles
from .scene.reflectivity_map import textured_body
from .scene.scene import Body, Scene
from .scene.sonar_sensor import SonarSensor
from .simulator import Simulator
from .sonar.counts import Counts
from .sonar.sampling import Sampling
from .sonar.sonar import Sonar, load_sonar, presets

__version__: str

__all__ = [
    "Acoustics",
    "Body",
    "Bubbles",
    "Camera",
    "Counts",
    "Error",
    "GBuffer",
    "Noise",
    "Ping",
    "Sampling",
    "Scene",
    "Simulator",
    "Sonar",
    "SonarSensor",
    "Water",
    "__version__",
    "bundled_scenes",
    "colorize",
    "demarco_image",
    "draw_axes",
    "embed",
    "fan_image",
    "load_npz",
    "load_scene",
    "load_sonar",
    "mujoco_poses",
    "mujoco_sonar_pose",
    "needed_acoustics",
    "ping_from_depth",
    "pose",
    "presets",
    "reference_ping",
    "save_animation",
    "save_npz",
    "save_png",
    "textured_body",
    "view",
]
