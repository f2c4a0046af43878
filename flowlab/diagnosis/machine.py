"""What a machine has: cores, memory, shared memory, GPU, OpenGL, and where flowlab and others keep what they made."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from flowlab.diagnosis.record import Diagnosis
from flowlab.errors import first_line
from flowlab.text import cut
from flowlab.user_cache import user_cache

_PROBE_S = 120
_GB = 1 << 30
_LITTLE_SHARED = _GB // 2
"""Docker gives a container 64 MB, and processes that load batches then die of a bus error."""


def find_hardware() -> Iterator[Diagnosis]:
    """Cores, memory and shared memory that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield Diagnosis("machine", "cores", str(cores))
    with suppress(AttributeError, ValueError, OSError):
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        yield Diagnosis("machine", "memory", f"{memory / _GB:.1f} GB")
    with suppress(OSError):
        size = shutil.disk_usage("/dev/shm").total
        little = size < _LITTLE_SHARED
        remedy = "in Docker, give --shm-size=2g" if little else ""
        yield Diagnosis("machine", "shared memory", f"{size / _GB:.2f} GB", "note" if little else "ok", remedy)


def find_gpu() -> Iterator[Diagnosis]:
    """What PyTorch can compute on."""
    try:
        import torch
    except Exception as error:  # a library that it was built for is missing, say
        yield Diagnosis("gpu", "torch", first_line(error), "problem", "reinstall torch")
        return
    built = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
    yield Diagnosis("gpu", "torch", f"{torch.__version__}, built {built}")
    if not torch.cuda.is_available():
        remedy = "look at nvidia-smi, and for the driver's version" if torch.version.cuda else ""
        yield Diagnosis("gpu", "cuda", "no device; everything is computed on the CPU", "note", remedy)
    for k in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
        about = torch.cuda.get_device_properties(k)
        with torch.cuda.device(k):
            bf16 = "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "no bf16"
        yield Diagnosis("gpu", f"cuda:{k}", f"{about.name}, {about.total_memory / _GB:.0f} GB, {bf16}")


def find_opengl() -> Iterator[Diagnosis]:
    """What draws color pictures of simulations; depth needs none."""
    command = [sys.executable, "-P", "-m", "flowlab.sim.render.gl_probe"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_S, check=False)
        found = json.loads(done.stdout)
    except subprocess.TimeoutExpired:
        found = {"error": f"did not answer within {_PROBE_S} s"}
    except ValueError:
        found = {"error": f"ended with {done.returncode}: {cut(done.stderr.strip()[-200:])}"}
    yield Diagnosis("opengl", "MUJOCO_GL", os.environ.get("MUJOCO_GL") or "not set: egl")
    if "error" in found:
        remedy = "only color pictures of simulations need it; in Docker with a GPU, NVIDIA_DRIVER_CAPABILITIES=all"
        yield Diagnosis("opengl", "renderer", cut(str(found["error"]), 400), "note", remedy)
        return
    yield Diagnosis("opengl", "renderer", f"{found['renderer']}, OpenGL {found['version']}")
    if "egl_devices" in found:
        yield Diagnosis("opengl", "EGL devices", str(found["egl_devices"]))


def find_caches() -> Iterator[Diagnosis]:
    """Where what can be made again is kept, how much of it there is, and whether there is room."""
    try:
        cache = user_cache()
    except OSError as error:
        yield Diagnosis("caches", "flowlab", str(error.strerror), "note", "set FLOWLAB_CACHE to a folder")
    else:
        yield _cache("flowlab", cache, "FLOWLAB_CACHE")
    torch_home = os.environ.get("TORCH_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "torch")
    yield _cache("weights of trackers (torch.hub)", Path(torch_home).expanduser(), "TORCH_HOME")
    numba = os.environ.get("NUMBA_CACHE_DIR") or "beside the modules, or in the user's cache where these are read-only"
    yield Diagnosis("caches", "compiled kernels (Numba)", numba)


def _cache(name: str, folder: Path, variable: str) -> Diagnosis:
    """A folder that need not be there yet: its size, and whether it can be written to."""
    there = next(p for p in (folder, *folder.parents) if p.exists())
    if not os.access(there, os.W_OK):
        return Diagnosis("caches", name, f"{folder}: cannot be written", "note", f"set {variable} to a folder that can")
    size = sum(_bytes(Path(at, file)) for at, _, files in os.walk(folder) for file in files)
    free = shutil.disk_usage(there).free
    little = free < 2 * _GB
    found = f"{folder}: {size / _GB:.2f} GB, {free / _GB:.0f} GB free"
    return Diagnosis(
        "caches", name, found, "note" if little else "ok", f"make room, or set {variable}" if little else ""
    )


def _bytes(path: Path) -> int:
    with suppress(OSError):
        return path.lstat().st_size
    return 0
