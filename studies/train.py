"""train: one entry to all that is learnt: MomentNet ("default"), ContactNet ("contacts"), the paper's UNet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from stmpl_core.errors import InvalidInput, sentence_of

TrainPreset = Literal[
    "default", "contacts", "tissue", "paper", "paper-reduced", "paper-3-bodies", "paper-reduced-3-bodies"
]
TOOLS: dict[str, Any] = {"kinds": ("indenter",), "steps": 20_000}  # settings of a MomentNet for what tools press with
STICK = {"stick": True, "hidden": 64, "points": 160}  # of one for what is left where skin goes with its tools
STACK_CONTACTS = {"weight_decay": 0.05, "batch": 96}  # their seed is one more than asked
STACK_MOMENTS = {"hidden": 64, "weight_decay": 0.3, "steps": 3_000, "points": 192}
OnProgress = Callable[[int, int, str], None]  # done, in all, what to say of it


def train(
    preset: TrainPreset, data: Path, out: Path, *, steps: int | None = None, seed: int = 0,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Trains on a data set, or goes on where an earlier run into the same folder was stopped.

    Args:
        preset: "default": MomentNet. "contacts": what rigid tools press with (ContactNet) and what that does
            (MomentNet once more), on data of the preset of that name. "tissue": the same on stacks, to the bone.
            "paper": the paper's UNet at 512 x 512 (for a GPU, or several under torchrun);
            "paper-reduced": the same code at a size that one CPU core trains in under an hour; "-3-bodies": without the
            second and fourth body, as in the paper's second set-up.
        data: folder of a finished data set.
        out: folder for weights, card and checkpoint.
        steps: number of steps of the optimiser for ours, of epochs for the paper's; None: the preset's.
        seed: seed of weights and order.
        on_progress: function that is called often.

    Returns:
        The card that was written beside the weights.

    Raises:
        InvalidInput: no finished data set, or steps that are too few.
    """
    changes: dict[str, Any] = {"seed": seed}
    if preset.startswith("paper"):
        from studies.train_unet import UNetTraining, train_unet

        changes |= {"bodies": "three_bodies" if preset.endswith("3-bodies") else "all"}
        changes |= {} if steps is None else {"epochs": steps}
        unet = _settings(UNetTraining.reduced if "reduced" in preset else UNetTraining, changes)
        return train_unet(data, out, unet, on_progress=on_progress)
    from studies.train_moments import MomentTraining, train_moments

    changes |= {} if steps is None else {"steps": steps}
    if preset == "default":
        return train_moments(data, out, _settings(MomentTraining, changes), on_progress=on_progress)
    from fem_tools.dataset import Dataset
    from fem_tools.rounds import read_all
    from stmpl_core.networks import Weights
    from studies.judge_contact import bound_motion
    from studies.train_contact import ContactTraining, tools_of, train_contact

    contacts, moments = _settings(ContactTraining, changes), _settings(MomentTraining, TOOLS | changes)
    if preset == "tissue":
        contacts = _settings(ContactTraining, STACK_CONTACTS | changes | {"seed": seed + 1})
        moments = _settings(MomentTraining, TOOLS | STACK_MOMENTS | changes)
    motion, pressure = ("stack_moment_net", "stack_contact_net") if preset == "tissue" else \
        ("moment_net_contact", "contact_net")  # fmt: skip
    tools_of(Dataset.open(data))  # before the first network is trained
    read_all(data)
    train_moments(data, out, moments, name=motion, on_progress=on_progress)
    card = train_contact(data, out, contacts, name=pressure, on_progress=on_progress)
    if preset == "contacts":
        law = Weights.load(out / f"{pressure}.safetensors", "pressure")
        moments = _settings(MomentTraining, TOOLS | STICK | changes)
        train_moments(data, out, moments, name="moment_net_stick", law=law, on_progress=on_progress)
        card |= {"stick": bound_motion(data, out, "moment_net_stick", pressure)}
    return card | {"motion": bound_motion(data, out, motion, pressure)}


def _settings(make: Callable[..., Any], changes: dict[str, Any]) -> Any:
    """The settings that `make` builds. Raises InvalidInput where it refuses them."""
    try:
        return make(**changes)
    except ValidationError as error:
        raise InvalidInput(f"the training cannot be set up so: {sentence_of(error)}.") from error
