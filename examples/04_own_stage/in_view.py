"""A stage of your own: keep out episodes whose points are mostly out of sight.

    flowlab extract-sim drawer-open --recipe examples/04_own_stage/recipe.yaml --episodes 3 --out data/seen

A stage is a class with settings for fields and one method, ``process``, whose annotations say which record it takes and
which it gives; a recipe in which the types of neighbors do not fit is refused when it is read. The recipe beside this
file names the class as ``in_view:InView``, and is looked for beside the recipe. What is rejected is listed, with the
reason, in the table at the end and in ``rejects.jsonl``.
"""

from flowlab.pipeline.stage import Rejected, Stage
from flowlab.records import Episode


class InView(Stage):
    """Keep episodes whose query points stay in view."""

    min_share: float = 0.5
    """Share of points and steps that must be visible."""

    def process(self, record: Episode) -> Episode:
        """The same episode, if enough of it was seen."""
        share = record.tracks.visible.mean()
        if share < self.min_share:
            raise Rejected(f"only {share:.0%} of the points are in view")
        return record
