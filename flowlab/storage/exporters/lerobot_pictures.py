"""Color and depth of a dataset as features of LeRobot."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from flowlab.records import Episode
from flowlab.storage.exporters.lerobot_features import ExportPlan
from flowlab.storage.exporters.lerobot_stats import evenly
from flowlab.storage.exporters.lerobot_tables import as_pictures, place_of
from flowlab.storage.exporters.lerobot_videos import (
    DEPTH_CODE,
    VideoCodec,
    VideoWriter,
    depth_codes,
    depth_image,
    depth_mm,
    png,
)

_SAMPLED, _ACROSS = 20, 64
"""Statistics are made of so many pictures of an episode, and of about so many pixels along each side of one."""


class PictureFeature:
    """A feature with a picture for each step."""

    def __init__(
        self, name: str, size: tuple[int, int], kind: Literal["rgb", "mm", "m", "video"],
        video: VideoWriter | None, codec: VideoCodec | None, fps: int,
    ) -> None:  # fmt: skip
        self.name, self._size, self._kind = name, size, kind
        self._video, self._codec, self._fps = video, codec, fps

    @property
    def is_video(self) -> bool:
        """Whether its pictures are frames of a video."""
        return self._video is not None

    @property
    def channels(self) -> int:
        """Numbers of each pixel."""
        return 3 if self._kind == "rgb" else 1

    def write(self, episode: Episode, k: int) -> tuple[Any, Mapping[str, Any] | None]:
        """The column of an episode's pictures, or where they are in a video; what of both it is not is None."""
        pictures = self._pictures(episode)
        if self._video is not None:
            part = self._video.add(map(depth_codes, pictures) if self._kind == "video" else pictures)
            return None, {**place_of(part.file),
                          "from_timestamp": part.from_s, "to_timestamp": part.to_s}  # fmt: skip
        suffix = ".tiff" if self._kind == "m" else ".png"
        coded = [png(p) if self._kind == "rgb" else depth_image(p, self._kind) for p in pictures]
        return as_pictures(coded, [f"frame-{t:06d}{suffix}" for t in range(len(coded))]), None

    def sample(self, episode: Episode) -> Float64[np.ndarray, "K C"]:
        """Pixels for statistics: colors from 0 to 1, depth in the unit of the feature."""
        pictures = list(self._pictures(episode))
        step = max(1, max(self._size) // _ACROSS)
        some = np.stack([pictures[t][::step, ::step] for t in evenly(len(pictures), _SAMPLED)])
        some = some / 255 if self._kind == "rgb" else some if self._kind == "m" else depth_mm(some)
        return np.asarray(some, np.float64).reshape(-1, self.channels)

    def to_json(self, camera: Mapping[str, Any]) -> dict[str, Any]:
        """As ``meta/info.json`` has it."""
        height, width = self._size
        info: dict[str, Any] = {"is_depth_map": self._kind != "rgb"}
        info |= {"depth_unit": "m" if self._kind == "m" else "mm"} if self._kind != "rgb" else {}
        if self._codec is not None:
            codec = "h264" if self._codec.name == "libx264" else "hevc"
            info |= {"video.height": height, "video.width": width, "video.codec": codec,
                     "video.pix_fmt": self._codec.pixels, "video.fps": self._fps, "video.channels": self.channels,
                     "video.g": self._codec.group, "has_audio": False}  # fmt: skip
        info |= {f"video.{key}": value for key, value in DEPTH_CODE.items()} if self._kind == "video" else {}
        return {
            "dtype": "image" if self._video is None else "video",
            "shape": [height, width, self.channels],
            "names": ["height", "width", "channels"],
            "info": info | ({"camera": dict(camera)} if camera else {}),
        }

    def close(self) -> None:
        """End the last video."""
        if self._video is not None:
            self._video.close()

    def _pictures(self, episode: Episode) -> Iterator[np.ndarray]:
        pictures = episode.rgb if self._kind == "rgb" else episode.depth
        assert pictures is not None
        yield from pictures


def picture_features(
    plan: ExportPlan,
    folder: Path,
    *,
    camera: str,
    rgb: Literal["video", "image"],
    depth: Literal["mm", "m", "video"],
    crf: int,
    most_bytes: int,
) -> list[PictureFeature]:
    """The features of the pictures that a dataset keeps.

    Args:
        plan: What is written.
        folder: Where.
        camera: What the camera is called.
        rgb: How color is written.
        depth: How depth is written.
        crf: Quality of the color video.
        most_bytes: Of a video file.
    """
    made = []
    for what, size in plan.pictures.items():
        name = f"observation.images.{camera}{'_depth' if what == 'depth' else ''}"
        kind: Any = "rgb" if what == "rgb" else depth
        codec = None
        if (rgb if what == "rgb" else depth) == "video":
            codec = VideoCodec.of_color(*size, crf) if what == "rgb" else VideoCodec.of_depth()
        video = None if codec is None else VideoWriter(folder / "videos" / name, codec, size, plan.fps, most_bytes)
        made.append(PictureFeature(name, size, kind, video, codec, plan.fps))
    return made
