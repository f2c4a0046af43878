"""Read a dataset: what is in an episode, and how its points move.

    flowlab extract-sim drawer-open --episodes 3 --out data/drawers
    python examples/01_read_a_dataset.py data/drawers

A dataset is a sequence of episodes. Nothing is read before it is asked for, and then one episode at a time. An episode
holds what happened as arrays with a row for every step: clouds, states, actions, and the position of every query point
in meters. ``flow`` is the difference of these positions from one row to the next.
"""

import sys

import numpy as np

import flowlab
from flowlab.records import Role

dataset = flowlab.open_dataset(sys.argv[1])
print(dataset)

for episode in dataset:
    steps, points, _ = episode.tracks.xyz_world.shape
    path_m = np.linalg.norm(episode.flow, axis=-1).sum(axis=0)  # (points,) meters along each point's path
    on_object = episode.query_role == Role.OBJECT
    print(
        f"{episode.task} seed {episode.seed}: {steps} steps, {points} query points; "
        f"the {on_object.sum()} on the object travel {path_m[on_object].mean():.2f} m, "
        f"{episode.tracks.visible.mean():.0%} of all positions are in sight"
    )

first = dataset[0]
print(first)
gripper = first.state[:, :3]  # MetaWorld: where the hand is, in the frame of the clouds
nearest = np.linalg.norm(first.point_cloud - gripper[:, None], axis=-1).min(axis=1)
print(f"the nearest point of the cloud is {1000 * np.median(nearest):.0f} mm from the hand, in the median of the steps")
