"""The numbers a network computes in: fp32, or bf16 where the device has units for it."""

from collections.abc import Callable
from typing import Any, Literal

import torch

from flowlab.errors import UsageError

Precision = Literal["auto", "fp32", "bf16"]


def choose_precision(asked: str, device: torch.device) -> str:
    """``fp32`` or ``bf16``, as asked; ``auto`` is bf16 where the device has units for it."""
    if asked == "auto":
        return "bf16" if has_bf16(device) else "fp32"
    if asked == "bf16" and not has_bf16(device):
        raise UsageError(f"--precision bf16: {device} has no units for it, and would be slower; use fp32")
    return asked


def has_bf16(device: torch.device) -> bool:
    """Whether a device multiplies matrices faster in bf16: two to four times, where it can at all."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)  # older PyTorch has none
    return bool(capabilities().get("avx512_bf16"))
