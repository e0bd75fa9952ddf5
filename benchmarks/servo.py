"""Alignments from random starts, theta up to 90 deg off: python benchmarks/servo.py [starts] [first].

Each start is the setting of configs/servo.toml (640 x 480 px, 2 grey levels of noise, uneven light, velocities off by
0.05 um/s rms) with both parts elsewhere. Printed: how they ended, the largest true errors, and the limits.
"""

from __future__ import annotations

import sys

import torch
from rich.console import Console
from rich.table import Table

from torch_ecc.commands.servo_job import setting
from torch_ecc.paper.servo_trials import Trial, random_start, trial
from torch_ecc.servo.record import Ending

NM_PER_PX = 275.0
console = Console(width=110)


def main(starts: int, first: int) -> None:
    trials: list[Trial] = []
    for number in range(first, first + starts):
        found = trial(setting(start=random_start(number)))
        trials.append(found)
        console.print(f"start {number}: {found.ending.name}, {_words(found)}")
    good = [t for t in trials if t.ending == Ending.ALIGNED]
    within = [t for t in good if max(t.substrate_px, t.tip_px) <= 0.1 and t.substrate_deg <= 0.02]
    table = Table("figure", "value", title=f"{starts} random starts", title_justify="left")
    table.add_row("aligned", str(len(good)))
    table.add_row("aligned within 0.1 px (27.5 nm) and 0.02 deg, by the simulator's account", str(len(within)))
    if good:
        for name, values in (("substrate", [t.substrate_px for t in good]), ("tip", [t.tip_px for t in good])):
            most, rms = max(values), torch.tensor(values).square().mean().sqrt()
            table.add_row(f"{name}: largest, rms", f"{_length(most)}, {_length(float(rms))}")
        table.add_row("substrate: largest error of theta", f"{max(t.substrate_deg for t in good):.4f} deg")
        table.add_row("frames: fewest, most", f"{min(t.frames for t in good)}, {max(t.frames for t in good)}")
    table.add_row("largest velocity, acceleration over their limits", _limits(trials))
    console.print(table)


def _words(t: Trial) -> str:
    return f"substrate {t.substrate_px:.3f} px, {t.substrate_deg:.4f} deg, tip {t.tip_px:.3f} px, {t.frames} frames"


def _length(px: float) -> str:
    return f"{px:.3f} px = {NM_PER_PX * px:.1f} nm"


def _limits(trials: list[Trial]) -> str:
    return f"{max(t.speed for t in trials):.3f}, {max(t.acceleration for t in trials):.3f}"


if __name__ == "__main__":
    torch.set_num_threads(1)
    numbers = [int(text) for text in sys.argv[1:]]
    main(*(numbers + [50, 0][len(numbers) :]))
