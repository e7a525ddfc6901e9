"""A haptic device of yours: settings of its loop, and the stiffest virtual coupling that stays passive on it.

python -m benchmarks.device --mass 0.1 --damping 0.2 --resolution 2e-5 --rate 1000 --delay 1

Its motion is simulated, in a grip of 300 N/m and 2 N s/m; the contact is the real law, on a hard skin (500 kPa).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from benchmarks.haptic_device import Device, Hand, Spot, arm_spot, play
from benchmarks.haptics import HARD, LEVELS, last_passive, settings_for
from stmpl_core.console import print_figures
from stmpl_core.haptics import LoopSettings


@dataclass(frozen=True)
class Found:
    """What suits a device.

    Args:
        settings: settings with the controller, and the stiffest coupling that stayed passive; None: none did.
        without: stiffest coupling without the controller [N/m]; 0: none.
        bound: bound of Colgate and Schenkel (1994) for a spring, 2 b / (T + 2 d) [N/m].
    """

    settings: LoopSettings | None
    without: float
    bound: float


def found(device: Device, spot: Spot, hand: Hand | None = None) -> Found:
    """The stiffest couplings on a device, of the levels of benchmarks.haptics.

    Args:
        device: device.
        spot: place on a skin.
        hand: hand that presses, holds and lets go.
    """
    by, hard = hand or Hand(), spot.with_modulus(HARD)
    best = [last_passive(LEVELS, lambda k, on=on: play(device, by, settings_for(device, k, on), hard))
            for on in (True, False)]  # fmt: skip
    late = (1 + 2 * device.delay_steps) / device.rate
    bound = 2 * (device.damping + by.damping) / late
    return Found(None if best[0] is None else settings_for(device, LEVELS[best[0][0]], True),
                 0.0 if best[1] is None else LEVELS[best[1][0]], bound)  # fmt: skip


def main() -> None:
    """Prints what suits a device."""
    known = Device()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mass", type=float, default=known.mass, help="mass that the hand feels [kg]")
    parser.add_argument("--damping", type=float, default=known.damping, help="damping of its bearings [N s/m]")
    parser.add_argument("--resolution", type=float, default=known.resolution, help="one count of its encoders [m]")
    parser.add_argument("--noise", type=float, default=known.noise, help="standard deviation on what they read [m]")
    parser.add_argument("--rate", type=float, default=known.rate, help="rate of its loop [Hz]")
    parser.add_argument("--delay", type=int, default=0, help="samples between a force's command and its effect")
    parser.add_argument("--cutoff", type=float, default=known.cutoff, help="cut-off of its velocity's low-pass [Hz]")
    given = vars(parser.parse_args())
    suits = found(Device(delay_steps=given.pop("delay"), **given), arm_spot())
    if suits.settings is None:
        print_figures(f"no coupling from {LEVELS[0]} N/m on stays passive: try a shorter delay or a higher rate.")
    else:
        s = suits.settings
        print_figures(f"LoopSettings(coupling_stiffness={s.coupling_stiffness}, most_damping={s.most_damping:.3g}, "
                      f"velocity_noise={s.velocity_noise:.2g}, delay_steps={s.delay_steps})")  # fmt: skip
    print_figures(f"tried: {LEVELS[0]} to {LEVELS[-1]} N/m; without the controller {suits.without:g}; "
                  f"2 b / (T + 2 d) is {suits.bound:.0f}")  # fmt: skip


if __name__ == "__main__":
    main()
