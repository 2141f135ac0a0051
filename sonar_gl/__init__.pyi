"""Public names of sonar_gl: this file is both what type checkers read and what `__init__.py` loads lazily."""

# with `as`, since Jedi, which completes names in editors, takes others in a stub for its own
from . import embed as embed
from .acoustics.acoustics import Acoustics as Acoustics
from .acoustics.water import Water as Water
from .analysis.reference import reference_ping as reference_ping
from .analysis.terms import needed_acoustics as needed_acoustics
from .core.errors import Error as Error
from .core.poses import pose as pose
from .embed.camera import Camera as Camera
from .embed.sensor import ping_from_depth as ping_from_depth
from .imaging.axes import draw_axes as draw_axes
from .imaging.demarco2015 import demarco_image as demarco_image
from .imaging.fan_image import colorize as colorize
from .imaging.fan_image import fan_image as fan_image
from .imaging.files import load_npz as load_npz
from .imaging.files import save_animation as save_animation
from .imaging.files import save_npz as save_npz
from .imaging.files import save_png as save_png
from .live.viewer import view as view
from .noise.settings import Noise as Noise
from .ping import GBuffer as GBuffer
from .ping import Ping as Ping
from .scene.load import bundled_scenes as bundled_scenes
from .scene.load import load_scene as load_scene
from .scene.mujoco_model import mujoco_poses as mujoco_poses
from .scene.mujoco_model import mujoco_sonar_pose as mujoco_sonar_pose
from .scene.plume import Bubbles as Bubbles
from .scene.reflectivity_map import textured_body as textured_body
from .scene.scene import Body as Body
from .scene.scene import Scene as Scene
from .scene.sonar_sensor import SonarSensor as SonarSensor
from .simulator import Simulator as Simulator
from .sonar.counts import Counts as Counts
from .sonar.sampling import Sampling as Sampling
from .sonar.sonar import Sonar as Sonar
from .sonar.sonar_files import load_sonar as load_sonar
from .sonar.sonar_files import presets as presets
from .sonar.sonar_files import save_sonar as save_sonar

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
    "save_sonar",
    "textured_body",
    "view",
]
