"""Run by the Python of an environment with LeRobot: opens a folder with its own class, and says what comes out."""

import sys
from pathlib import Path

import lerobot
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def main(folder: str, out: str) -> None:
    """Every item, its values by name; and windows of two steps, as policies are trained on."""
    dataset = LeRobotDataset("any/name", root=folder, video_backend="pyav")
    items = [dataset[k] for k in range(len(dataset))]
    values = {n: np.stack([np.asarray(item[n]) for item in items]) for n in items[0] if n != "task"}
    tasks = np.array([item["task"] for item in items])
    steps = {"observation.point_cloud": [-1 / dataset.fps, 0], "action": [k / dataset.fps for k in range(4)]}
    window = LeRobotDataset("any/name", root=folder, video_backend="pyav", delta_timestamps=steps)[1]
    windows = {f"window/{n}": np.asarray(window[n]) for n in steps}
    stats = {f"stats/{n}/{k}": np.asarray(v) for n, s in dataset.meta.stats.items() for k, v in s.items()}
    solved = [bool(e["success"]) for e in dataset.meta.episodes]
    camera = {
        f"camera/{n}": np.asarray(f["info"]["camera"]["K"])
        for n, f in dataset.meta.features.items()
        if "camera" in f.get("info", {})
    }
    np.savez(out, version=lerobot.__version__, **values, task=tasks, success=solved, **windows, **stats, **camera)
    print(
        f"LeRobot {lerobot.__version__} opens {Path(folder).name}: {dataset.num_episodes} episodes, "
        f"{len(dataset)} steps"
    )
    for name, rows in values.items():
        print(f"  {name} {rows.dtype} {rows.shape[1:]}")


if __name__ == "__main__":
    main(*sys.argv[1:])
