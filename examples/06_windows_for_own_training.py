"""Windows of a dataset for a training loop of one's own, in plain PyTorch.

    flowlab extract-sim drawer-open --episodes 10 --out data/drawer
    python examples/06_windows_for_own_training.py data/drawer

Nothing of flowlab's policies is used: :class:`flowlab.data.Windows` is a map-style dataset, as any DataLoader takes it.
"""

import sys

import torch
from torch import nn

import flowlab


def main(data: str, epochs: int = 3) -> float:
    """Learn actions from the robot's state and the flow of query points; the error on the last episode."""
    dataset = flowlab.data.Windows(data, {"state": [-1, 0], "flow": [-1], "action": range(8)})
    print(dataset)
    every = dataset.episodes
    train = flowlab.data.Windows(data, dataset.offsets, episodes=every[:-1])
    held_out = flowlab.data.Windows(data, dataset.offsets, episodes=every[-1:])
    stats, action = train.stats, train[0]["action"]

    def inputs(batch: dict[str, torch.Tensor]) -> torch.Tensor:
        state = (batch["state"] - stats["state"]["mean"]) / stats["state"]["std"].clamp(min=1e-4)
        moved = batch["flow"].norm(dim=-1).mean(-1) / stats["flow"]["std"].norm()
        return torch.cat([state.flatten(1), moved], 1)

    width = inputs(next(iter(torch.utils.data.DataLoader(train)))).shape[1]
    network = nn.Sequential(nn.Linear(width, 128), nn.ReLU(), nn.Linear(128, action.numel()))
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3)
    loader = torch.utils.data.DataLoader(train, batch_size=64, shuffle=True, num_workers=1)
    for epoch in range(epochs):
        for batch in loader:
            error = (network(inputs(batch)).view_as(batch["action"]) - batch["action"]).abs()
            loss = error[~batch["action_is_pad"]].mean()  # what lies behind the end of an episode was not demonstrated
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        print(f"epoch {epoch}: loss {loss.item():.3f}")
    with torch.no_grad():
        (last,) = torch.utils.data.DataLoader(held_out, batch_size=len(held_out))
        error = (network(inputs(last)).view_as(last["action"]) - last["action"]).abs()
        found = float(error[~last["action_is_pad"]].mean())
    print(f"mean absolute error of the actions of an episode that was not trained on: {found:.3f}")
    return found


if __name__ == "__main__":
    main(sys.argv[1])
