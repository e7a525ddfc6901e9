"""train: one entry to all that is learnt: "default" is ours (MomentNet), "paper" and its kin are the paper's UNet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

TrainPreset = Literal["default", "paper", "paper-reduced", "paper-3-bodies", "paper-reduced-3-bodies"]
OnProgress = Callable[[int, int, str], None]  # done, in all, what to say of it


def train(
    preset: TrainPreset, data: Path, out: Path, *, steps: int | None = None, seed: int = 0,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Trains on a data set, or goes on where an earlier run into the same folder was stopped.

    Args:
        preset: "default": MomentNet. "paper": the paper's UNet at 512 x 512 (for a GPU, or several under torchrun);
            "paper-reduced": the same code at a size that one CPU core trains in under an hour; "-3-bodies": without the
            second and fourth body, as in the paper's second set-up.
        data: folder of a finished data set.
        out: folder for weights, card and checkpoint.
        steps: of the optimiser for "default", epochs for the paper's; None: the preset's.
        seed: of weights and order.
        on_progress: called often.

    Returns:
        The card that was written beside the weights.

    Raises:
        InvalidInput: no finished data set.
    """
    if preset == "default":
        from fem_tools.train_moments import MomentTraining, train_moments

        moments = MomentTraining(seed=seed)
        if steps is not None:
            moments = moments.model_copy(update={"steps": steps})
        return train_moments(data, out, moments, on_progress=on_progress)
    from fem_tools.train_unet import UNetTraining, train_unet

    changes: dict[str, Any] = {"seed": seed, "bodies": "three_bodies" if preset.endswith("3-bodies") else "all"}
    if steps is not None:
        changes["epochs"] = steps
    settings = UNetTraining.reduced(**changes) if "reduced" in preset else UNetTraining(**changes)
    return train_unet(data, out, settings, on_progress=on_progress)
