"""One process, or several under ``torchrun`` that share every batch."""

import ctypes
import os
import warnings
from contextlib import AbstractContextManager, nullcontext, suppress

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from flowlab.errors import UsageError
from flowlab.policies.base import PolicyNetwork
from flowlab.training.precision import choose_precision

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Of ``malloc.h``."""


def is_first_process() -> bool:
    """Whether this is the process that writes and reports."""
    return os.environ.get("RANK", "0") == "0"


class ProcessGroup:
    """This process among those that train together, and the device it computes on."""

    def __init__(self, device: str, threads: int, precision: str) -> None:
        self.rank, self.count = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        kind, _, number = device.partition(":")
        if kind not in ("cpu", "cuda") or not (number or "0").isdecimal():
            raise UsageError(f"--device {device}: there is no such device; use cpu, cuda or cuda:1")
        index = int(number or os.environ.get("LOCAL_RANK", "0"))
        if kind == "cuda" and index >= torch.cuda.device_count():
            found = "no such GPU" if torch.cuda.is_available() else "no GPU"
            raise UsageError(f"--device {device}: PyTorch sees {found} here; use --device cpu")
        self.device = torch.device("cuda", index) if kind == "cuda" else torch.device(device)
        if kind == "cuda":
            torch.cuda.set_device(self.device)  # what NCCL, and all that names no GPU, goes by
        self.precision = choose_precision(precision, self.device)
        torch.set_num_threads(threads)
        _reuse_freed_memory()
        if self.count > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if self.device.type == "cuda" else "gloo")

    @property
    def description(self) -> str:
        """Device, processes, threads and precision, for people."""
        threads = f", {torch.get_num_threads()} threads" if torch.get_num_threads() > 1 else ""
        processes = f"{self.count} processes on " if self.count > 1 else ""
        return f"{processes}{self.device}{threads}, {self.precision}"

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes and reports."""
        return self.rank == 0

    def part(self, windows: int) -> slice:
        """This process's part of a batch of so many windows."""
        if windows % self.count:
            raise UsageError(f"batch.windows is {windows}, which {self.count} processes cannot share evenly")
        size = windows // self.count
        return slice(self.rank * size, (self.rank + 1) * size)

    def wrap(self, policy: PolicyNetwork) -> nn.Module:
        """The policy as it is called for its losses: with several processes, gradients become those of all parts."""
        if self.count == 1:
            return policy
        ids = [self.device.index] if self.device.type == "cuda" else None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # from PyTorch 2.13 on, it is called forward_sync_buffers
            return DistributedDataParallel(policy, device_ids=ids, broadcast_buffers=False)

    def autocast(self) -> AbstractContextManager[object]:
        """In which the losses are computed: matrix products in the precision asked for."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.precision == "bf16" else nullcontext()

    def mean(self, values: dict[str, Tensor]) -> dict[str, float]:
        """Means over all processes, as numbers."""
        together = torch.stack([v.float() for v in values.values()])
        if self.count > 1:
            distributed.all_reduce(together)
        return dict(zip(values, (together / self.count).tolist(), strict=True))

    def any(self, yes: bool) -> bool:
        """Whether any process says yes; all get the same answer."""
        if self.count == 1:
            return yes
        votes = torch.tensor(int(yes), device=self.device)
        distributed.all_reduce(votes)
        return bool(votes)

    def broadcast(self, number: int) -> int:
        """The first process's number, in all of them."""
        if self.count == 1:
            return number
        shared = torch.tensor(number, device=self.device)
        distributed.broadcast(shared, 0)
        return int(shared)

    def wait(self) -> None:
        """Until all processes are here."""
        if self.count > 1:
            distributed.barrier()

    def close(self) -> None:
        """Leave the group."""
        if self.count > 1:
            distributed.destroy_process_group()


def _reuse_freed_memory() -> None:
    """Have glibc reuse what is freed: else it hands every large array back and gets it anew in each step.

    A tenth of a training step's time. Elsewhere than on glibc nothing happens.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 32 << 20)  # the most it takes
        mallopt(_M_TRIM_THRESHOLD, 1 << 30)
