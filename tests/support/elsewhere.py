"""Runs code of sonar_gl in a process that lacks what Windows or macOS lack. Neither is the real system.

`python -m tests.support.elsewhere SYSTEM sonar-gl ARGUMENT...` runs a command, `... SYSTEM SCRIPT` a file of Python.
Processes that it spawns import this module first, as all that are spawned import the main module.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import multiprocessing
import os
import runpy
import signal
import sys
import types
import warnings
from contextlib import suppress
from importlib.abc import MetaPathFinder

SYSTEMS = {"windows": "win32", "macos": "darwin"}
VARIABLE = "EMULATED_SYSTEM"
# functions and numbers of modules that a system lacks
BOTH_LACK = {
    os: ("sched_getaffinity", "sched_setaffinity", "posix_fadvise", "posix_fallocate", "memfd_create"),
    mmap: ("MADV_HUGEPAGE", "MADV_NOHUGEPAGE", "MAP_POPULATE"),
}
WINDOWS_LACKS = {
    os: (
        *("register_at_fork", "fork", "forkpty", "sysconf", "statvfs", "sync", "getuid", "geteuid", "getgid"),
        *("mkfifo", "mknod", "pread", "pwrite", "chown", "getpgid", "setsid", "nice", "uname", "getloadavg"),
        *("O_DIRECTORY", "O_NONBLOCK", "O_CLOEXEC", "O_NOFOLLOW", "O_SYNC"),
    ),
    signal: ("SIGHUP", "SIGALRM", "SIGUSR1", "alarm", "setitimer", "pthread_kill", "siginterrupt"),
    mmap: ("MAP_PRIVATE", "MAP_SHARED", "MAP_ANONYMOUS", "MAP_ANON", "PROT_READ", "PROT_WRITE"),
}
WINDOWS_LACKS_MODULES = "fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "syslog", "readline"
NO_EGL_MODULES = "glcontext.egl", "glcontext.x11"  # of Linux's wheels only
FORBIDDEN_IN_NAMES = set('<>:"|?*')
DEVICE_NAMES = {"con", "prn", "aux", "nul"}


def emulate(system: str) -> None:
    """Take from this process what a system lacks; before sonar_gl is imported."""
    warnings.filterwarnings("ignore", category=EncodingWarning)  # of other packages
    import asyncio  # noqa: F401 - modules of Python that would choose another system's functions
    import subprocess  # noqa: F401
    from multiprocessing import popen_spawn_posix, resource_tracker  # noqa: F401

    import cv2  # noqa: F401
    import numpy  # noqa: F401
    import trimesh  # noqa: F401

    windows = system == "windows"
    _emulate_libraries(windows)
    if windows:
        sys.modules["msvcrt"] = _msvcrt()
        _emulate_descriptors()
        sys.addaudithook(_forbid)
    _LackedModules.block(NO_EGL_MODULES + (WINDOWS_LACKS_MODULES if windows else ()))
    for lacking in (BOTH_LACK, WINDOWS_LACKS) if windows else (BOTH_LACK,):
        for module, names in lacking.items():
            for name in names:
                with suppress(AttributeError):
                    delattr(module, name)
    multiprocessing.set_start_method("spawn", force=True)
    warnings.filterwarnings("error", category=EncodingWarning, module=r"sonar_gl\.")
    from sonar_gl.raster import engine

    # of this module alone: other packages would look for libraries of the system
    engine.sys = types.SimpleNamespace(platform=SYSTEMS[system])


class _LackedModules(MetaPathFinder):
    """Has the import of some modules fail."""

    def __init__(self, names):
        self._names = names

    @classmethod
    def block(cls, names) -> None:
        for name in names:
            sys.modules.pop(name, None)
        sys.meta_path.insert(0, cls(names))

    def find_spec(self, name, path=None, target=None):
        if name in self._names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def _emulate_libraries(windows: bool) -> None:
    load = ctypes.CDLL.__init__

    def init(self, name, *arguments, **named):
        if name is None and windows:
            raise TypeError("argument of type 'NoneType' is not iterable")
        if name is not None and os.path.basename(str(name)).startswith(("libEGL", "libGL.")):
            raise OSError(f"dlopen({name}, 0x0006): no such file")
        load(self, name, *arguments, **named)

    def find(self, name):
        if name in ("malloc_trim", "mallopt", "syncfs"):  # of glibc
            raise AttributeError(name)
        return get(self, name)

    get = ctypes.CDLL.__getattr__
    ctypes.CDLL.__init__, ctypes.CDLL.__getattr__ = init, find


def _emulate_descriptors() -> None:
    """Windows opens no folders, and flushes only what is open for writing."""
    import fcntl

    open_, fsync, get_flags, flags_of = os.open, os.fsync, fcntl.fcntl, fcntl.F_GETFL

    def open_file(path, flags, mode=0o777, **named):
        if os.path.isdir(path) and flags & os.O_TMPFILE != os.O_TMPFILE:
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return open_(path, flags, mode, **named)

    def flush(file):
        number = file if isinstance(file, int) else file.fileno()
        if get_flags(number, flags_of) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        fsync(number)

    os.open, os.fsync = open_file, flush


def _msvcrt() -> types.ModuleType:
    """Return what Windows locks files by, made of what Linux locks them by."""
    import fcntl

    flock, lock, at_once, unlock = fcntl.flock, fcntl.LOCK_EX, fcntl.LOCK_NB, fcntl.LOCK_UN
    out = types.ModuleType("msvcrt")
    out.LK_UNLCK, out.LK_LOCK, out.LK_NBLCK = 0, 1, 2

    def locking(number, mode, n_bytes):
        try:
            flock(number, unlock if mode == out.LK_UNLCK else lock | at_once)
        except BlockingIOError:
            raise PermissionError(errno.EACCES, "Permission denied") from None

    out.locking = locking
    return out


def _forbid(event: str, arguments: tuple) -> None:
    """Raise what Windows raises for names that it refuses, and for files that are open where they are moved."""
    if event == "open" and isinstance(arguments[0], (str, bytes, os.PathLike)):
        if (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            _check_name(arguments[0])
    elif event == "os.mkdir":
        _check_name(arguments[0])
    elif event in ("os.rename", "os.remove"):
        for path in arguments[: 2 if event == "os.rename" else 1]:
            _check_name(path)
            _check_closed(path)


def _check_name(path) -> None:
    path = os.fsdecode(path)
    if path.startswith(("/dev/", "/proc/")):
        return
    name = os.path.basename(path)
    is_device = name.partition(".")[0].lower() in DEVICE_NAMES
    if set(name) & FORBIDDEN_IN_NAMES or name.endswith((".", " ")) or is_device:
        raise OSError(errno.EINVAL, "Invalid argument", path)


def _check_closed(path) -> None:
    place = os.path.realpath(os.fsdecode(path))
    for number in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):
            if os.readlink(f"/proc/self/fd/{number}") == place:
                raise PermissionError(errno.EACCES, "the file is used by another process", place)


if __name__ == "__main__":
    os.environ[VARIABLE] = sys.argv[1]
if VARIABLE in os.environ:
    emulate(os.environ[VARIABLE])
if __name__ == "__main__":
    sys.argv = sys.argv[2:]
    if sys.argv[0] == "sonar-gl":
        from sonar_gl.cli.main import main

        main()
    else:
        runpy.run_path(sys.argv[0], run_name="__main__")
