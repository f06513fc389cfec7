"""A policy that looks for what breaks the limits: it learns from how close each of its attempts came.

An attempt is a set of square waves, one per joint, with its own period, phase and share of time spent in each
direction. Attempts that came closest to a limit, or past it, are kept, and the next ones are drawn around them (a
cross-entropy search with a floor under its spread, so that it never settles).
"""

import numpy as np

from robotctl.hal.types import Vector

_ELITE = 6
_POPULATION = 24
_PERIOD_S = (0.1, 3.0)
_FLOOR = 0.15
"""Least standard deviation of what is drawn, as a share of each parameter's range 0..1."""


class Search:
    """Draws attempts, and takes how close each came."""

    def __init__(self, dof: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._mean = np.full((3, dof), 0.5)
        self._spread = np.full((3, dof), 0.5)
        self._judged: list[tuple[float, Vector]] = []
        self._attempt = self._draw()
        self.best = -np.inf
        """The closest that any attempt came; positive past a limit."""

    def action(self, time_s: float) -> Vector:
        """Return the action (n,) in -1..1 at a time since the attempt began."""
        period, phase, duty = self._attempt
        cycle = (time_s / (_PERIOD_S[0] * (_PERIOD_S[1] / _PERIOD_S[0]) ** period) + phase) % 1.0
        return np.where(cycle < 0.1 + 0.8 * duty, 1.0, -1.0)

    def judge(self, closest: float) -> None:
        """Take how close the attempt came, and begin the next one."""
        self.best = max(self.best, closest)
        self._judged.append((closest, self._attempt))
        if len(self._judged) == _POPULATION:
            elite = np.array([attempt for _, attempt in sorted(self._judged, key=lambda one: -one[0])[:_ELITE]])
            self._mean = elite.mean(axis=0)
            self._spread = np.maximum(elite.std(axis=0), _FLOOR)
            self._judged.clear()
        self._attempt = self._draw()

    def _draw(self) -> Vector:
        return np.asarray(np.clip(self._rng.normal(self._mean, self._spread), 0.0, 1.0))
