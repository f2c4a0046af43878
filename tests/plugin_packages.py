"""Little packages that offer plug-ins, as pip would have installed them: a module and its ``dist-info``."""

import os
from pathlib import Path


def install(folder: Path, name: str, module: str, **entry_points: str) -> Path:
    """Put a package with one module into a folder.

    ``entry_points`` names what it offers by family, as in ``trackers="circle = circles:Circle"``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(module)
    about = folder / f"{name}-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    groups = [f"[flowlab.{family}]\n{entries}\n" for family, entries in entry_points.items()]
    (about / "entry_points.txt").write_text("\n".join(groups))
    return folder


def environment(folder: Path) -> dict[str, str]:
    """The environment of a process that finds the packages of a folder."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
