"""Linear dynamics in closed form: second-order axes behind creep, driven by signals that are straight in pieces.

An axis is G(s) (1 + sum_j c_j / (1 + tau_j s)) with G(s) = omega^2 / (s^2 + 2 zeta omega s + omega^2): the creep is a
chain of Kelvin-Voigt elements (Croft, Shed and Devasia, "Creep, hysteresis, and vibration compensation for
piezoactuators", J. Dyn. Sys. Meas. Control 123 (2001) 35); one per decade with equal c is the logarithmic creep that
makers give, c per decade. In partial fractions every pole p has a state z with dz/dt = p z + v, and a step of length d
in which v starts from V and has ramps of slope g in its last tau_i seconds takes it to::

    exp(p d) z + d phi_1(p d) V + sum_i g_i tau_i^2 phi_2(p tau_i),
    phi_1(x) = (e^x - 1) / x,   phi_2(x) = (e^x - 1 - x) / x^2

There is no step error: the length of the steps changes nothing but the rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from torch_ecc.sim.stage.hysteresis import Ramps


@dataclass(frozen=True, eq=False)
class Plant:
    """P poles of A axes: ``poles`` (P,) complex, ``residues`` (P, A) complex; the output is Re sum_p residue_p z_p."""

    poles: Tensor
    residues: Tensor

    @classmethod
    def of(
        cls, natural_hz: Tensor, damping: Tensor, *, creep: Tensor | None = None, creep_s: Tensor | None = None
    ) -> Plant:
        """Axes (A,) of these natural frequencies and damping ratios < 1; gains and times (J,) of the creep elements."""
        omega = 2 * pi * natural_hz
        swing = omega * torch.complex(-damping, (1 - damping**2).sqrt())  # one pole of each conjugate pair
        gain = torch.zeros_like(omega[:0]) if creep is None else creep
        time = torch.ones_like(gain) if creep_s is None else creep_s

        def response(s: Tensor) -> Tensor:
            """G at (P, 1) for all axes: (P, A)."""
            return omega**2 / ((s - swing) * (s - swing.conj()))

        slow = -1 / time.to(swing)
        held = 1 + (gain / (1 + time * swing[:, None])).sum(1)
        fast = torch.diag(2 * omega**2 / (swing - swing.conj()) * held)
        return cls(torch.cat((swing, slow)), torch.cat((fast, (gain / time)[:, None] * response(slow[:, None]))))

    def to(self, device: torch.device) -> Plant:
        """The same axes on another device."""
        return Plant(self.poles.to(device), self.residues.to(device))

    def rest(self, drive: Tensor) -> Tensor:
        """States (P, ..., A) at which the axes have settled under a constant ``drive`` (..., A)."""
        return torch.stack([-drive / pole for pole in self.poles])

    def advance(self, states: Tensor, ramps: Ramps, mix: Tensor, length: Tensor) -> Tensor:
        """States (P, ..., S, A) after steps of ``length`` (S,) or () s: the same shape.

        ``ramps`` drives the actuators: values (..., S, A') at the starts of the steps, slopes and durations
        (..., S, A', N). ``mix`` (A, A') makes the drive of the axes of them.
        """
        pushes = self._push(ramps, mix, length)
        decay = [(pole * length)[..., None].exp() for pole in self.poles]
        return torch.stack([d * state + push for d, state, push in zip(decay, states, pushes, strict=True)])

    def march(self, start: Tensor, ramps: Ramps, mix: Tensor, length: Tensor) -> Tensor:
        """States (P, ..., S + 1, A) at the ends of S equal steps of ``length`` () s from ``start`` (P, ..., A)."""
        pushes = self._push(ramps, mix, length)
        return torch.stack(
            [recur((pole * length).exp(), z, push) for pole, z, push in zip(self.poles, start, pushes, strict=True)]
        )

    def output(self, states: Tensor) -> Tensor:
        """Position of the axes from their states: (P, ..., A) -> (..., A)."""
        return (states.movedim(0, -2) * self.residues).sum(-2).real

    def _push(self, ramps: Ramps, mix: Tensor, length: Tensor) -> list[Tensor]:
        """What the drive adds to every state in a step: P of (..., S, A)."""
        pushes = []
        for pole in self.poles:  # one at a time: the plays of all steps need much room
            base = ramps.value * (length * phi1(pole * length))[..., None]
            grown = (ramps.slope * ramps.duration**2 * phi2(pole * ramps.duration)).sum(-1)
            pushes.append((base + grown) @ mix.mT.to(pole))
        return pushes


def recur(factor: Tensor, start: Tensor, pushes: Tensor) -> Tensor:
    """z_k+1 = factor z_k + pushes_k from z_0 = ``start`` (..., A), in log2 S passes: (..., S, A) -> (..., S + 1, A)."""
    states = torch.cat((start[..., None, :], pushes), -2)
    shift = 1
    while shift < states.shape[-2]:
        states[..., shift:, :] += factor**shift * states[..., :-shift, :].clone()
        shift *= 2
    return states


def phi1(x: Tensor) -> Tensor:
    """(e^x - 1) / x of complex numbers, 1 at 0; any shape."""
    small = x.abs() < 1e-2
    safe = torch.where(small, torch.ones_like(x), x)
    return torch.where(small, _taylor(x, 1), (safe.exp() - 1) / safe)


def phi2(x: Tensor) -> Tensor:
    """(e^x - 1 - x) / x^2 of complex numbers, 1/2 at 0; any shape."""
    small = x.abs() < 1e-2
    safe = torch.where(small, torch.ones_like(x), x)
    return torch.where(small, _taylor(x, 2), (safe.exp() - 1 - safe) / safe**2)


def _taylor(x: Tensor, order: int) -> Tensor:
    """sum_n x^n / (n + order)!: exact to 1e-15 for |x| < 1e-2."""
    total, n = torch.zeros_like(x), 6
    for k in range(n, 0, -1):
        total = (1 + total) * x / (k + order)
    return (1 + total) / (1 if order == 1 else 2)
