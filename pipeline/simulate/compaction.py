"""Ground that every pass compacts: slip falls with the number of times that a place was driven over."""

from __future__ import annotations

import math

from pipeline.simulate.scenario import State

_SINE, _COSINE = math.sin(0.6), math.cos(0.6)
_AWAY_S = 3.0


class CompactedGround:
    """Odd physics for `Scenario.extra`: forward speed and turning lose a share that falls with each pass.

    The loss over a patch is ``first * ratio ** n`` after n passes. Patches are squares that are turned
    against the axes of the map; a pass is another one when the patch was left for seconds. It keeps a memory
    of one drive and forgets it when time starts again.

    Args:
        first: share of the motion that is lost on untouched ground.
        kept: share of that loss that each pass leaves; 1 for ground that does not change.
        patch_m: side of a patch.
        rough: patches differ in their loss by up to this share, either way.
    """

    def __init__(self, first: float, ratio: float, patch_m: float = 0.5, rough: float = 0.0) -> None:
        self.first, self.ratio, self.patch_m, self.rough = first, ratio, patch_m, rough
        self._passes: dict[tuple[int, int], int] = {}
        self._seen: dict[tuple[int, int], float] = {}
        self._last_s = math.inf

    def __call__(self, state: State) -> tuple[float, float, float]:
        """Velocity that the ground takes."""
        if state.t < self._last_s:
            self._passes, self._seen = {}, {}
        self._last_s = state.t
        along, across = _COSINE * state.x + _SINE * state.y, _COSINE * state.y - _SINE * state.x
        patch = math.floor(along / self.patch_m), math.floor(across / self.patch_m)
        if state.t - self._seen.get(patch, state.t) > _AWAY_S:
            self._passes[patch] = self._passes.get(patch, 0) + 1
        self._seen[patch] = state.t
        wave = math.sin(12.9898 * patch[0] + 78.233 * patch[1])
        loss = self.first * (1.0 + self.rough * wave) * self.ratio ** self._passes.get(patch, 0)
        return -loss * state.v0, 0.0, -loss * state.w0
