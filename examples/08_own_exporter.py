"""An exporter of your own: one compressed file an episode, for tools that read NumPy.

    python examples/08_own_exporter.py data/demo
    PYTHONPATH=examples flowlab export data/demo --to 08_own_exporter:NpzExporter --out data/npz

The fields of an exporter are its options, as in ``--set tracks=false``. ``new_folder`` makes a folder that is there
whole or not at all, which is what the checks ask for, killed in the middle or not.

A package that offers the class as an entry point makes it known by name::

    [project.entry-points."flowlab.exporters"]
    npz = "my_package.npz:NpzExporter"
"""

import sys
from pathlib import Path
from typing import ClassVar

import numpy as np

import flowlab
from flowlab.files import new_folder
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.base import Exporter, select_episodes
from flowlab.testing.exporters import check_exporter


class NpzExporter(Exporter):
    """Writes ``TASK-SEED.npz`` for every episode."""

    name: ClassVar[str] = "npz"
    writes: ClassVar[str] = "a folder of .npz files, for NumPy"
    tracks: bool = True
    """Write where the query points are, too."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        """See :class:`~flowlab.storage.exporters.base.Exporter`."""
        chosen = {(ref.task, ref.seed) for ref in select_episodes(dataset, path, task)}
        with new_folder(path) as folder:
            for episode in dataset.episodes():
                if (episode.task, episode.seed) in chosen:
                    arrays = {"point_cloud": episode.point_cloud, "state": episode.state, "action": episode.action}
                    arrays |= {"tracks": episode.tracks.xyz_world} if self.tracks else {}
                    np.savez_compressed(folder / f"{episode.task}-{episode.seed:06d}.npz", **arrays)
        return len(chosen)


if __name__ == "__main__":
    check_exporter(NpzExporter, flowlab.open_dataset(sys.argv[1]))
    print("keeps all that is asked of an exporter")
