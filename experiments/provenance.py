"""What a result was made with: versions, device, commit."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

import jax

_PACKAGES = (
    "tangentspace", "jax", "jaxlib", "numpy", "equinox", "optimistix", "lineax", "trimesh",
    "embreex", "OpenEXR",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Return the versions of Python and the packages that a result depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def device() -> str:
    """Return the name of the device that JAX computes on."""
    first = jax.devices()[0]
    return f"{first.device_kind} ({_processor()})" if first.platform == "cpu" else first.device_kind


def commit() -> str | None:
    """Return the commit of the source tree, with ``+`` where it was changed; None outside one."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) != folder.parent.resolve():
            return None
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    affinity = getattr(os, "sched_getaffinity", None)
    return f"{model}, {len(affinity(0)) if affinity else os.cpu_count()} cores"
