"""Folders in LeRobot's layouts, v3.0 and v2.1, written by hand from one filmed scene whose truth is known."""

import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hdf5_files import GIVEN, POSE, SIZE, STEPS, K, filmed

FPS = 20
CODE = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5, "use_log": True}
COLOR, DEPTH = "observation.images.front", "observation.images.front_depth"
CAMERA = {"K": K.tolist(), "T_world_cam": POSE.tolist(), "width": SIZE[0], "height": SIZE[1]}
TASK = "push the red box"


def codes(depth: np.ndarray) -> np.ndarray:
    """Logarithm of the distance, shifted, in 4096 steps; a hole falls on the first."""
    low, high = np.log(0.01 + 3.5), np.log(10 + 3.5)
    return np.clip(np.rint(4095 * (np.log(depth + 3.5) - low) / (high - low)), 0, 4095).astype("<u2")


def write_video(path: Path, pictures: np.ndarray, fps: int = FPS, codec: str | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    deep = pictures.ndim == 3
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec or ("libx265" if deep else "libx264"), rate=fps)
        stream.width, stream.height = pictures.shape[2], pictures.shape[1]
        kind = "depth" if deep else codec or "libx264"
        stream.pix_fmt = {"depth": "gray12le", "libx264": "yuv444p"}.get(kind, "yuv420p")
        stream.options = {
            "depth": {"x265-params": "lossless=1:log-level=none:bframes=0", "preset": "ultrafast"},
            "libx264": {"crf": "4", "bf": "0", "g": "2"},
            "libsvtav1": {"crf": "30", "preset": "12", "g": "2"},
        }[kind]
        for k, picture in enumerate(pictures):
            if deep:
                frame = av.VideoFrame(picture.shape[1], picture.shape[0], "gray12le")
                rows = np.frombuffer(frame.planes[0], np.uint8).reshape(-1, frame.planes[0].line_size)
                rows[: picture.shape[0], : 2 * picture.shape[1]] = picture.view(np.uint8).reshape(len(picture), -1)
            else:
                frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.pts = k
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def embedded(pictures: np.ndarray, suffix: str) -> pa.Array:
    rows = []
    for t, picture in enumerate(pictures):
        stored = picture if picture.ndim == 2 else picture[..., ::-1]
        rows.append({"bytes": cv2.imencode(suffix, stored)[1].tobytes(), "path": f"frame-{t:06d}{suffix}"})
    return pa.array(rows, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))


def feature(dtype: str, shape: list[int], names: Any = None, **info: Any) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "names": names, "info": info}


def features(color: str, depth: str, camera: dict[str, Any] | None) -> dict[str, Any]:
    size, about = [SIZE[1], SIZE[0]], {} if camera is None else {"camera": camera}
    kind = {
        "png": {"depth_unit": "mm"},
        "tiff": {"depth_unit": "m"},
        "video": {f"video.{k}": v for k, v in CODE.items()},
    }[depth]
    own = {
        "timestamp": "float32",
        "frame_index": "int64",
        "episode_index": "int64",
        "index": "int64",
        "task_index": "int64",
    }
    return {
        "observation.state": feature("float32", [9], {"motors": [f"joint_{k}" for k in range(9)]}),
        "action": feature("float32", [9]),
        COLOR: feature("video" if color == "video" else "image", [*size, 3], ["height", "width", "channels"], **about),
        DEPTH: feature("video" if depth == "video" else "image", [*size, 1], None, is_depth_map=True, **kind, **about),
        **{name: feature(dtype, [1]) for name, dtype in own.items()},
    }


def columns(k: int, color: str, depth: str, first: int = 0) -> dict[str, Any]:
    seen = filmed(k)
    own = {
        "observation.state": pa.array(seen.state.tolist(), pa.list_(pa.float32())),
        "action": pa.array(seen.action.tolist(), pa.list_(pa.float32())),
        "timestamp": pa.array(np.arange(STEPS, dtype=np.float32) / FPS),
        "frame_index": pa.array(range(STEPS)),
        "episode_index": pa.array([k] * STEPS),
        "index": pa.array(range(first, first + STEPS)),
        "task_index": pa.array([k] * STEPS),
    }
    if color != "video":
        own[COLOR] = embedded(seen.rgb, ".png")
    if depth != "video":
        own[DEPTH] = embedded(seen.mm if depth == "png" else seen.depth.astype(np.float32), f".{depth}")
    return own


def write_info(
    folder: Path, version: str, demos: int, color: str, depth: str, camera: Any, paths: list[str], **changed: Any
) -> None:
    info = {
        "codebase_version": version,
        "robot_type": "arm",
        "total_episodes": demos,
        "total_frames": demos * STEPS,
        "total_tasks": demos,
        "chunks_size": 1000,
        "fps": FPS,
        "splits": {"train": f"0:{demos}"},
        "data_path": paths[0],
        "video_path": paths[1],
        "features": features(color, depth, camera),
    }
    (folder / "meta").mkdir(parents=True, exist_ok=True)
    (folder / "meta/info.json").write_text(json.dumps(info | changed))


def videos(color: str, depth: str) -> dict[str, Any]:
    return {name: what for name, what, how in ((COLOR, "rgb", color), (DEPTH, "depth", depth)) if how == "video"}


def of(k: int, what: str) -> np.ndarray:
    return filmed(k).rgb if what == "rgb" else codes(filmed(k).depth)


def v3(
    folder: Path, demos: int = 2, color: str = "video", depth: str = "png", camera: Any = CAMERA, **changed: Any
) -> Path:
    """All episodes in one table, and in one video for each camera."""
    paths = [
        "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    ]
    write_info(folder, "v3.0", demos, color, depth, camera, paths, **changed)
    tables = [pa.table(columns(k, color, depth, k * STEPS)) for k in range(demos)]
    (folder / "data/chunk-000").mkdir(parents=True)
    pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
    rows: dict[str, Any] = {
        "episode_index": list(range(demos)),
        "tasks": [[f"{TASK} {k}"] for k in range(demos)],
        "length": [STEPS] * demos,
        "data/chunk_index": [0] * demos,
        "data/file_index": [0] * demos,
        "success": [k == 0 for k in range(demos)],
    }
    for name, what in videos(color, depth).items():
        write_video(
            folder / f"videos/{name}/chunk-000/file-000.mp4", np.concatenate([of(k, what) for k in range(demos)])
        )
        of_video = {
            "chunk_index": [0] * demos,
            "file_index": [0] * demos,
            "from_timestamp": [k * STEPS / FPS for k in range(demos)],
            "to_timestamp": [(k + 1) * STEPS / FPS for k in range(demos)],
        }
        rows |= {f"videos/{name}/{key}": values for key, values in of_video.items()}
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(rows), folder / "meta/episodes/chunk-000/file-000.parquet")
    tasks = {"task_index": list(range(demos)), "__index_level_0__": [f"{TASK} {k}" for k in range(demos)]}
    pq.write_table(pa.table(tasks), folder / "meta/tasks.parquet")
    return folder


def v21(
    folder: Path, demos: int = 2, color: str = "video", depth: str = "png", camera: Any = CAMERA, **changed: Any
) -> Path:
    """A table and a video for each episode; episodes and tasks line by line."""
    paths = [
        "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    ]
    write_info(folder, "v2.1", demos, color, depth, camera, paths, **changed)
    (folder / "data/chunk-000").mkdir(parents=True)
    for k in range(demos):
        pq.write_table(pa.table(columns(k, color, depth)), folder / f"data/chunk-000/episode_{k:06d}.parquet")
        for name, what in videos(color, depth).items():
            write_video(folder / f"videos/chunk-000/{name}/episode_{k:06d}.mp4", of(k, what))
    episodes = [
        {"episode_index": k, "tasks": [f"{TASK} {k}"], "length": STEPS, "success": k == 0} for k in range(demos)
    ]
    tasks = [{"task_index": k, "task": f"{TASK} {k}"} for k in range(demos)]
    for name, rows in (("episodes", episodes), ("tasks", tasks)):
        (folder / f"meta/{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


__all__ = ["CAMERA", "CODE", "COLOR", "DEPTH", "FPS", "GIVEN", "TASK", "codes", "v3", "v21", "write_video"]
