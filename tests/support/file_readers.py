"""All that reads files, each before a folder whose files of one stem are of a kind that is no plain file."""

import sonar_gl as sg
from sonar_gl.batch.job import read_job
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.poses import read_poses
from sonar_gl.scene import mesh_files
from sonar_gl.scene.reflectivity_map import read_image

SUFFIXES = ".sdf", ".glb", ".png", ".toml", ".csv", ".npz"
JOB = """scenes = ["{scene}"]
[[sonars]]
sonar = "{sonar}"
[[poses]]
kind = "trajectory"
file = "{file}"
"""
MODEL = "<sdf version='1.9'><model name='m'><link name='l'><collision name='c'><geometry>{}</geometry>{}</collision>"
MODEL += "</link></model></sdf>"
MESH = "<mesh><uri>{}</uri></mesh>"
MAP = "<sonar_gl:reflectivity_map>{}</sonar_gl:reflectivity_map>"
POSES = "t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n"


def write_scene(folder, geometry, more=""):
    """Write a scene of one body with this geometry, and return its path."""
    path = folder / "a.sdf"
    path.write_text(MODEL.format(geometry, more))
    return path


def run_job(folder, **names):
    """Write a job with files of these names, and return its first scene."""
    (folder / "sound.csv").write_text(POSES)
    names = {"scene": "pylon", "sonar": "p900-45", "file": "sound.csv"} | names
    (folder / "job.toml").write_text(JOB.format(**names))
    requests = BatchRequests(read_job(folder / "job.toml"))
    return requests.scenes[0]


READERS = {  # functions (folder, stem of the files that are read)
    "scene": lambda folder, stem: sg.load_scene(folder / f"{stem}.sdf"),
    "mesh": lambda folder, stem: sg.load_scene(folder / f"{stem}.glb"),
    "mesh of a scene": lambda folder, stem: sg.load_scene(write_scene(folder, MESH.format(f"{stem}.glb"))),
    "map of a scene": lambda folder, stem: sg.load_scene(
        write_scene(folder, "<box/>", MAP.format(f"{stem}.png"))
    ),
    "height map": lambda folder, stem: mesh_files.heightmap(folder / f"{stem}.png"),
    "reflectivity map": lambda folder, stem: read_image(folder / f"{stem}.png"),
    "sonar": lambda folder, stem: sg.load_sonar(folder / f"{stem}.toml"),
    "table of a sonar": lambda folder, stem: sg.load_sonar(f"{folder}/{stem}.toml#mine"),
    "poses": lambda folder, stem: read_poses(folder / f"{stem}.csv"),
    "ping": lambda folder, stem: sg.load_npz(folder / f"{stem}.npz"),
    "job": lambda folder, stem: read_job(folder / f"{stem}.toml"),
    "scene of a job": lambda folder, stem: run_job(folder, scene=f"{stem}.sdf"),
    "sonar of a job": lambda folder, stem: run_job(folder, sonar=f"{stem}.toml"),
    "poses of a job": lambda folder, stem: run_job(folder, file=f"{stem}.csv"),
}
