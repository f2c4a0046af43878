"""The Observer: unproject, crop, sample. There is one, for labeling, training data and evaluation."""

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.geometry.sampling import farthest_points
from flowlab.perception.cleaning import SWITCH, OutlierSettings, TableSettings, outlier_mask, table_mask
from flowlab.perception.point_cloud import pad, unproject_and_crop
from flowlab.records import Cloud, Entity, Frame, Observation, Role

Vector3 = tuple[float, float, float]


class Box(Settings):
    """An axis-aligned box in the world frame [m]; points strictly inside are kept."""

    low: Vector3
    """Least x, y, z."""
    high: Vector3
    """Greatest x, y, z."""

    @model_validator(mode="after")
    def _not_empty(self) -> "Box":
        if any(lo >= hi for lo, hi in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low {self.low} must be below high {self.high} on every axis")
        return self


class ObserverSettings(Settings):
    """How a depth picture becomes a point cloud. Stored in every dataset and every checkpoint."""

    points: int = Field(default=1024, gt=0)
    """Size of the sample."""
    crop: Box = Box(low=(-0.5, 0.25, -0.2), high=(0.5, 0.97, 0.8))
    """Workspace. The default holds everything that moves in all 50 MetaWorld tasks, holes included."""
    crop_of_task: Mapping[str, Box] = {}
    """Another workspace for single tasks."""
    drop_background: bool = True
    """Remove floor, walls and table by what owns the pixel; where owners are unknown the box must do."""
    padding: Literal["repeat", "zeros"] = "repeat"
    """What fills the sample when fewer points remain: its own points again, or zeros as DP3 does."""
    remove_table: Annotated[TableSettings | None, SWITCH] = None
    """Remove the largest plane in the crop and what lies below it; null keeps it."""
    remove_outliers: Annotated[OutlierSettings | None, SWITCH] = None
    """Then remove outliers; null keeps them."""

    def crop_for(self, task: str) -> Box:
        """The workspace of a task."""
        return self.crop_of_task.get(task, self.crop)


class Observer:
    """Turns frames of one task into clouds and observations.

    Source of the defaults: 3D FDP crops the static background of one fixed camera and keeps 1024 points
    by farthest-point sampling.
    """

    def __init__(self, settings: ObserverSettings, task: str) -> None:
        self.settings = settings
        self.task = task
        crop = settings.crop_for(task)
        self._low, self._high = np.array(crop.low), np.array(crop.high)
        self._kept: tuple[tuple[Entity, ...] | None, np.ndarray] = (None, np.ones(1, bool))

    def cloud(self, frame: Frame) -> Cloud:
        """Every point of the frame inside the crop that is not cleared away, in pixel order."""
        owner = np.full((1, 1), -1, np.int16) if frame.owner is None else frame.owner
        cam = frame.camera
        xyz, pixel = unproject_and_crop(
            frame.depth, owner, self._kept_owners(frame.entities), cam.K, cam.T_world_cam, self._low, self._high
        )
        if self.settings.remove_table is not None:
            kept = ~table_mask(xyz, cam.T_world_cam[:3, 3], self.settings.remove_table)
            xyz, pixel = xyz[kept], pixel[kept]
        if self.settings.remove_outliers is not None:
            kept = ~outlier_mask(xyz, self.settings.remove_outliers)
            xyz, pixel = xyz[kept], pixel[kept]
        return Cloud(xyz, pixel, None if frame.owner is None else owner.reshape(-1)[pixel], frame.entities)

    def sample(self, cloud: Cloud) -> Observation:
        """The farthest-point sample of a cloud."""
        if len(cloud.xyz_world) == 0:
            raise DataError(self._nothing_there())
        index = farthest_points(cloud.xyz_world, self.settings.points)
        return Observation(pad(cloud.xyz_world[index], self.settings.points, self.settings.padding), len(index))

    def observe(self, frame: Frame) -> Observation:
        """What a policy sees of a frame."""
        cloud = self.cloud(frame)
        if not len(cloud.xyz_world):
            raise DataError(f"{self._nothing_there()}; {_extent(frame)}")
        return self.sample(cloud)

    def _nothing_there(self) -> str:
        return (
            f"{self.task}: no point of the frame lies in the crop {self.settings.crop_for(self.task)}; "
            "set observer.crop to the workspace of the scene"
        )

    def _kept_owners(self, entities: tuple[Entity, ...]) -> np.ndarray:
        """Whether to keep a pixel, by owner; the last entry is for owner -1."""
        if self._kept[0] is not entities:
            kept = [not self.settings.drop_background or e.role is not Role.BACKGROUND for e in entities]
            self._kept = (entities, np.array([*kept, True]))
        return self._kept[1]


def _extent(frame: Frame) -> str:
    """Where the points of a frame lie, in words."""
    everywhere = np.full(3, np.inf)
    owner, cam = np.full((1, 1), -1, np.int16), frame.camera
    xyz, _ = unproject_and_crop(frame.depth, owner, np.ones(1, bool), cam.K, cam.T_world_cam, -everywhere, everywhere)
    if not len(xyz):
        return "the frame has no depth reading"
    low, high = np.quantile(xyz, [0.01, 0.99], axis=0)
    return f"its points lie in low=({', '.join(f'{x:.2f}' for x in low)}) high=({', '.join(f'{x:.2f}' for x in high)})"
