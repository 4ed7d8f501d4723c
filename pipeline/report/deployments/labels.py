"""Where names stand so that they hide neither each other nor the marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

_LETTER, _LINE = 6.7, 13.0
_MARK = 9.0
_STEPS = (0.0, 14.0, -14.0, 28.0, -28.0, 42.0, -42.0)


@dataclass(frozen=True)
class Box:
    """A rectangle in pixels, y upward."""

    left: float
    right: float
    low: float
    high: float

    def overlaps(self, other: Box) -> bool:
        """Whether two rectangles share a point."""
        return (
            self.left < other.right
            and other.left < self.right
            and self.low < other.high
            and other.low < self.high
        )


def place_labels(
    marks: Sequence[tuple[float, float]],
    names: Sequence[str],
    *,
    width: float,
    obstacles: Sequence[Box] = (),
    furthest: float = 42.0,
    apart: float = 0.0,
) -> list[tuple[float, float] | None]:
    """Left ends of the names' middle lines, one a mark, greedily in the order given.

    Each name tries right and left of its mark, then some lines higher and lower; the first place that hides
    nothing and stays on the map is taken.

    Args:
        marks: positions in pixels, y upward.
        names: as many texts.
        width: of the map in pixels.
        obstacles: what else must stay visible.
        apart: from other marks, beside which a name would seem to be theirs [pixels].
        furthest: how much higher or lower than its mark a name may stand [pixels].

    Returns:
        A place for each name, None where there is none.
    """
    taken = list(obstacles)
    own = [Box(x - _MARK, x + _MARK, y - _MARK, y + _MARK) for x, y in marks]
    others = [Box(box.left - apart, box.right + apart, box.low, box.high) for box in own]
    placed: list[tuple[float, float] | None] = []
    steps = [step for step in _STEPS if abs(step) <= furthest]
    for i, ((x, y), name) in enumerate(zip(marks, names, strict=True)):
        long = _LETTER * len(name)
        places = [(left, y + step) for step in steps for left in (x + _MARK + 3.0, x - _MARK - 3.0 - long)]
        hidden = [*taken, own[i], *others[:i], *others[i + 1 :]]
        free = [
            place
            for place in places
            if place[0] >= 0.0
            and place[0] + long <= width
            and not any(_frame(place, long).overlaps(box) for box in hidden)
        ]
        if not free:
            placed.append(None)
            continue
        taken.append(_frame(free[0], long))
        placed.append(free[0])
    return placed


def _frame(place: tuple[float, float], long: float) -> Box:
    x, y = place
    return Box(x, x + long, y - _LINE / 2.0, y + _LINE / 2.0)
