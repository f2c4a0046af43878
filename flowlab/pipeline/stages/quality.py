"""Which labeled episodes are good enough to learn from."""

import numpy as np
from pydantic import Field

from flowlab.pipeline.stage import Rejected, Stage
from flowlab.records import Episode


class QualityStage(Stage):
    """Keeps out episodes whose tracks are too poor to learn from; they can still be looked at."""

    stage: str = "quality"
    sure_m: float = Field(default=0.05, gt=0)
    """A position counts as sure if the camera sees the point and its stated error is below this [m]."""
    min_sure_share: float = Field(default=0.25, ge=0, le=1)
    """Share of all positions, over points and frames, that must be sure."""
    max_median_sigma_m: float = Field(default=0.05, gt=0)
    """Median stated error of visible points [m] that is still good enough: labels of which half may be farther off are
    not to be trusted."""
    max_lost_share: float = Field(default=0.8, ge=0, le=1)
    """Share of the points that may be lost for good, that is, not visible in the last tenth of the episode."""

    def process(self, record: Episode) -> Episode:
        """Let an episode pass whose tracks are good enough."""
        if record.tracks.quality is None:
            return record
        distinct = slice(record.queries.count)
        visible, sigma = record.tracks.visible[:, distinct], record.tracks.quality.sigma[:, distinct]
        sure = float((visible & (sigma < self.sure_m)).mean())
        median = float(np.median(sigma[visible])) if visible.any() else np.inf
        lost = float((~visible[-max(1, len(visible) // 10) :].any(0)).mean())
        complaint = ""
        if sure < self.min_sure_share:
            complaint = (
                f"{sure:.0%} of all positions are seen with a stated error below {self.sure_m * 1e3:g} mm, "
                f"at least {self.min_sure_share:.0%} asked for (quality.min_sure_share)"
            )
        elif median > self.max_median_sigma_m:
            complaint = (
                f"the median stated error of visible points is {median * 1e3:.1f} mm, "
                f"at most {self.max_median_sigma_m * 1e3:g} mm asked for (quality.max_median_sigma_m)"
            )
        elif lost > self.max_lost_share:
            complaint = (
                f"{lost:.0%} of the points are lost for good before the end, "
                f"at most {self.max_lost_share:.0%} asked for (quality.max_lost_share)"
            )
        if complaint:
            raise Rejected(complaint, episode=record)
        return record
