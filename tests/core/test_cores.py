"""The count of cores respects the shares of time that containers have."""

import os

import pytest

from sonar_gl.core import cores

ALL = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
V1 = "4:memory:/job\n3:cpu,cpuacct:/job\n"


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A machine of 64 cores; a function that writes the groups of this process and their files."""
    monkeypatch.setattr(cores.os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    monkeypatch.setattr(cores, "OWN_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(cores, "GROUPS", tmp_path / "groups")

    def write(own: str, **files: str) -> None:
        (tmp_path / "cgroup").write_text(own)
        for name, text in files.items():
            file = tmp_path / "groups" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)

    return write


@pytest.mark.parametrize(
    ("own", "files", "n_cores"),
    [
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 64),
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 2),  # one and a half: the second is not idle
        ("0::/\n", {"cpu.max": "10000 100000\n"}, 1),
        ("0::/\n", {}, 64),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000\n", "a/b/cpu.max": "max 100000\n"}, 3),
        ("0::/a/b\n", {"a/cpu.max": "max 100000\n", "a/b/cpu.max": "400000 100000\n"}, 4),
        # the path of the host, where the group of the container is on top
        ("0::/system/docker-1\n", {"cpu.max": "200000 100000\n"}, 2),
        (V1, {"cpu/job/cpu.cfs_quota_us": "250000\n", "cpu/job/cpu.cfs_period_us": "50000\n"}, 5),
        (V1, {"cpu/job/cpu.cfs_quota_us": "-1\n", "cpu/job/cpu.cfs_period_us": "100000\n"}, 64),
        (V1, {"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
        ("0::/\n", {"cpu.max": "nonsense\n"}, 64),
    ],
)
def test_a_share_of_time_limits_the_cores(system, own, files, n_cores):
    system(own, **files)
    assert cores.count_cores() == n_cores


def test_limits_outside_the_groups_do_not_count(system, tmp_path):
    """A path never leads above the folder of all groups."""
    (tmp_path / "cpu.max").write_text("100000 100000\n")
    system("0::/../..\n", **{"cpu.max": "400000 100000\n"})
    assert cores.count_cores() == 4


def test_without_groups_all_cores_count(tmp_path, monkeypatch):
    monkeypatch.setattr(cores, "OWN_GROUPS", tmp_path / "none")
    assert cores.count_cores() == ALL


@pytest.mark.parametrize(("numba_num", "share", "n"), [(64, 3, 3), (64, 64, 8), (2, 64, 2), (6, 3, 6)])
def test_threads_fill_the_share_of_time_of_a_container(monkeypatch, numba_num, share, n):
    """Numba knows the cores of the machine alone; a number that is set counts."""
    monkeypatch.setattr(cores.numba.config, "NUMBA_DEFAULT_NUM_THREADS", 64)
    monkeypatch.setattr(cores.numba.config, "NUMBA_NUM_THREADS", numba_num)
    monkeypatch.setattr(cores, "count_cores", lambda: share)
    assert cores.n_threads() == n
