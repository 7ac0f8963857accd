"""Which elements the points speak for: fewer where they do not, and which law a transition follows.

Segmentation finds elements, the adjustment tells how sure each is. An arc whose curvature is none within its sigma is a straight, a
transition shorter than its sigma is none, and what is the same on both sides of it becomes one. Laws of transitions are tried one
after another on all of them; the one that fits best counts, and another only where the points insist.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.fitting.plan import Chain, PlanFit
from railnav.track import elements

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A value within this many sigmas of nothing is nothing.
NOTHING = 3.0
#: A transition that bends the other way over less than this share of it does not.
_HARDLY = 0.03
#: Arcs less bent than this, 1/m, are hardly built, those less bent than that not at all, and what that weighs in -2 log likelihood.
_WIDEST, _ODD = 1.0 / 40_000.0, 20.0
_NO_ARC, _NOT_BUILT = 1.0 / 300_000.0, 200.0
#: A transition is none within this many sigmas of its length.
_NO_LENGTH = 2.0


@dataclass(frozen=True, slots=True)
class Item:
    """One element: its kind, length, curvatures, start, and whether curvature passes on from the one before."""

    kind: int
    length: float
    k0: float
    k1: float
    start: tuple[float, float, float]
    smooth: bool
    sway: float = 0.0


def items_of(chain: Chain) -> list[Item]:
    """Elements of a chain one by one."""
    rows = zip(chain.kind.tolist(), chain.length.tolist(), chain.k0.tolist(), chain.k1.tolist(), strict=True)
    return [
        Item(
            kind,
            length,
            k0,
            k1,
            (float(chain.start[j, 0]), float(chain.start[j, 1]), float(chain.start[j, 2])),
            j > 0 and bool(chain.first[j] == chain.last[j - 1]),
            float(chain.sway[j]),
        )
        for j, (kind, length, k0, k1) in enumerate(rows)
    ]


def chain_of(items: list[Item]) -> Chain:
    """Elements tied together: arcs have one curvature, transitions take those of their neighbours."""
    m = len(items)
    first, last = np.full(m, -1), np.full(m, -1)
    values: list[float] = []

    def new(value: float) -> int:
        values.append(value)
        return len(values) - 1

    for j, item in enumerate(items):
        if item.kind == elements.ARC:
            first[j] = last[j] = new(item.k0)
    for j, item in enumerate(items):
        if item.kind < elements.CLOTHOID:
            continue
        if item.smooth and j > 0:
            first[j] = last[j - 1]
        else:
            first[j] = -1 if item.k0 == 0.0 else new(item.k0)
        follows = j + 1 < m and items[j + 1].smooth
        if follows and items[j + 1].kind < elements.CLOTHOID:
            last[j] = first[j + 1]
        elif follows and item.k1 == 0.0 and items[j + 1].k0 == 0.0:
            last[j] = -1  # a point of inflection
        else:
            last[j] = -1 if item.k1 == 0.0 else new(item.k1)
    return Chain(
        np.array([item.kind for item in items], np.int64),
        np.array([item.length for item in items]),
        first,
        last,
        np.array(values),
        np.array([item.start for item in items]),
        np.array([item.sway for item in items]),
    )


def split_inflections(items: list[Item]) -> list[Item]:
    """Transitions that bend both ways, cut where they are straight."""
    from railnav.track.elements import Plan, integrate

    out: list[Item] = []
    rest = list(items)
    for j in range(len(rest)):
        item = rest[j]
        if item.kind < elements.CLOTHOID or not item.k0 * item.k1 < 0.0:
            out.append(item)
            continue
        share = item.k0 / (item.k0 - item.k1)
        before, after = share * item.length, (1.0 - share) * item.length
        last = out[-1] if out else None
        following = rest[j + 1] if j + 1 < len(rest) else None
        hardly = max(0.5, _HARDLY * item.length)
        if before < hardly and (last is None or last.kind != elements.ARC or not item.smooth):
            if last is not None and last.kind >= elements.CLOTHOID and item.smooth:
                out[-1] = replace(last, k1=0.0)
            straight = last is not None and last.kind == elements.STRAIGHT
            out.append(replace(item, k0=0.0, smooth=item.smooth or straight))
            continue
        if after < hardly and (following is None or following.kind != elements.ARC or not following.smooth):
            out.append(replace(item, k1=0.0))
            if following is not None and following.kind >= elements.CLOTHOID and following.smooth:
                rest[j + 1] = replace(following, k0=0.0)
            elif following is not None and following.kind == elements.STRAIGHT:
                rest[j + 1] = replace(following, smooth=True)
            continue
        one = np.array([0.0])
        plan = Plan(
            one + before,
            np.array([elements.CLOTHOID]),
            one + item.k0,
            one,
            one + item.start[0],
            one + item.start[1],
            one + item.start[2],
            one,
        )
        point, bearing = integrate(plan, np.array([before]))
        out.append(replace(item, length=before, k1=0.0))
        start = (float(point[0, 0]), float(point[0, 1]), float(bearing[0]))
        out.append(replace(item, length=after, k0=0.0, start=start, smooth=True))
    return out


def simplifications(
    items: list[Item],
    bend_sigma: FloatArray,
    length_sigma: FloatArray,
    *,
    least: float = 0.5,
    jump: float = 0.0,
    peak: float = 0.0,
) -> list[Edit]:
    """Edits that leave out what the points do not speak for; none overlaps another.

    Parameters
    ----------
    items : list of Item
    bend_sigma : (m,) array
        Of arcs' curvatures, 1/m.
    length_sigma : (m,) array
        m.
    least : float
        Shorter elements are none, m.
    jump : float
        How much rarer curvature jumps than it runs on, in -2 log likelihood: a transition that may well be none weighs as little of
        that as it is shorter than its sigma.
    peak : float
        How much rarer transitions meet in a peak of curvature than with an arc between, in -2 log likelihood.
    """
    edits: list[Edit] = []
    free = 0
    for j, item in enumerate(items):
        before = items[j - 1] if j > 0 else None
        lo = j - 1 if before is not None else j
        if lo < free:
            continue
        edit = _without(items, j, bend_sigma, length_sigma, least)
        if edit is not None and item.kind >= elements.CLOTHOID and edit.fewer == 1 and len(edit.items) == 2:
            known = item.length / max(_NO_LENGTH * float(length_sigma[j]), least, 1e-9)
            edit = replace(edit, bonus=-jump * min(known, 1.0))
        if (
            edit is not None
            and item.kind == elements.ARC
            and all(part.kind >= elements.CLOTHOID for part in edit.items)
        ):
            edit = replace(edit, bonus=edit.bonus - peak)
        if edit is None and item.kind == elements.ARC and abs(item.k0) < NOTHING * bend_sigma[j]:
            changed = _straightened(items, j)
            edit = Edit(lo, lo + len(changed), changed, 1)
        if edit is not None and edit.first >= free:
            edits.append(edit)
            free = edit.last
    return edits


def _without(items: list[Item], j: int, bend_sigma: FloatArray, length_sigma: FloatArray, least: float) -> Edit | None:
    """The edit that leaves out element j, or makes it one with its neighbours; None where it stands."""
    item = items[j]
    before = items[j - 1] if j > 0 else None
    after = items[j + 1] if j + 1 < len(items) else None
    if before is not None and _same(before, item, bend_sigma[j - 1], bend_sigma[j]):
        return Edit(j - 1, j + 1, (replace(before, length=before.length + item.length),), 2)
    none = item.length < max(_NO_LENGTH * length_sigma[j], least)
    half = 0.5 * item.length
    if item.kind >= elements.CLOTHOID:
        if before is not None and after is not None and max(before.kind, after.kind) < elements.CLOTHOID:
            if _same(before, after, bend_sigma[j - 1], bend_sigma[j + 1]):
                length = before.length + item.length + after.length
                bonus = (
                    _ODD if before.kind == elements.STRAIGHT else 0.0
                )  # no transition leads from a straight to itself
                return Edit(j - 1, j + 2, (replace(before, length=length),), 3, bonus)
            if none:
                pair = (
                    replace(before, length=before.length + half),
                    replace(after, length=after.length + half, smooth=False, start=_back(after, half)),
                )
                return Edit(j - 1, j + 2, pair, 1)
        if none:
            if before is not None and before.kind >= elements.CLOTHOID and item.smooth:
                return Edit(j - 1, j + 1, (replace(before, length=before.length + item.length, k1=item.k1),), 2)
            if after is not None and after.kind >= elements.CLOTHOID and after.smooth:
                return Edit(j, j + 2, (replace(item, length=after.length + item.length, k1=after.k1),), 2)
        return None
    if not none or before is None or after is None:
        return None
    turning = before.kind >= elements.CLOTHOID, after.kind >= elements.CLOTHOID
    if all(turning) and item.smooth and after.smooth:
        pair = (
            replace(before, length=before.length + half),
            replace(after, length=after.length + half, start=_back(after, half)),
        )
        return Edit(j - 1, j + 2, pair, 1)
    if turning[0] and not turning[1]:
        pair = (
            replace(before, length=before.length + half, k1=after.k0),
            replace(after, length=after.length + half, smooth=True, start=_back(after, half)),
        )
        return Edit(j - 1, j + 2, pair, 1)
    if not any(turning):
        pair = (
            replace(before, length=before.length + half),
            replace(after, length=after.length + half, smooth=False, start=_back(after, half)),
        )
        return Edit(j - 1, j + 2, pair, 2)
    if turning[1] and not turning[0]:
        pair = (
            replace(before, length=before.length + half),
            replace(after, length=after.length + half, k0=before.k1, smooth=True, start=_back(after, half)),
        )
        return Edit(j - 1, j + 2, pair, 1)
    return None


def _back(item: Item, by: float) -> tuple[float, float, float]:
    east, north, bearing = item.start
    return east - by * float(np.sin(bearing)), north - by * float(np.cos(bearing)), bearing - by * item.k0


def _same(a: Item, b: Item, sigma_a: float, sigma_b: float) -> bool:
    """Whether two plain elements are one."""
    if a.kind == b.kind == elements.STRAIGHT:
        return True
    if a.kind == b.kind == elements.ARC:
        return abs(a.k0 - b.k0) < NOTHING * float(np.hypot(sigma_a, sigma_b))
    return False


def with_law(chain: Chain, law: int | IntArray) -> Chain:
    """The chain with another law of its transitions: one for all, or (m,) one an element."""
    kind = np.where(chain.kind >= elements.CLOTHOID, law, chain.kind)
    between = (kind == elements.CUBIC) & (chain.first >= 0) & (chain.last >= 0)
    return replace(chain, kind=np.where(between, elements.CLOTHOID, kind).astype(np.int64))


@dataclass(frozen=True, slots=True)
class Edit:
    """A change to try: the elements from `first` to before `last` become `items`, with `fewer` unknowns.

    `bonus` is by how much railways build the new elements rather than the old ones, in -2 log likelihood.
    """

    first: int
    last: int
    items: tuple[Item, ...]
    fewer: int
    bonus: float = 0.0


def hardly_bent(items: list[Item]) -> list[Edit]:
    """Edits that make a straight of an arc wider than railways build."""
    edits: list[Edit] = []
    for j, item in enumerate(items):
        lo, hi = max(j - 1, 0), min(j + 2, len(items))
        if item.kind != elements.ARC or abs(item.k0) > _WIDEST or (edits and edits[-1].last > lo):
            continue
        bonus = _NOT_BUILT if abs(item.k0) < _NO_ARC else _ODD
        edits.append(Edit(lo, hi, _straightened(items, j), 1, bonus))
    return edits


def hollow(items: list[Item], least: float) -> list[int]:
    """Places of transitions that move the track by less than `least` m."""
    return [
        j
        for j, item in enumerate(items)
        if item.kind >= elements.CLOTHOID
        and item.kind != elements.VIENNESE
        and abs(item.k1 - item.k0) * item.length**2 / 24.0 < least
    ]


def without_hollow(items: list[Item], j: int) -> list[Item]:
    """The elements with transition j, which bends nothing, as part of a plain neighbour."""
    item = items[j]
    bend = 0.5 * (item.k0 + item.k1)
    beside = [i for i in (j - 1, j + 1) if 0 <= i < len(items) and items[i].kind < elements.CLOTHOID]
    if not beside:
        kind = elements.STRAIGHT if bend == 0.0 else elements.ARC
        return [*items[:j], replace(item, kind=kind, k0=bend, k1=bend), *items[j + 1 :]]
    near = min(beside, key=lambda i: abs(items[i].k0 - bend))
    long = replace(items[near], length=items[near].length + item.length)
    if near > j:
        return [*items[:j], replace(long, start=item.start, smooth=item.smooth), *items[j + 2 :]]
    out = [*items[: j - 1], long]
    rest = items[j + 1 :]
    if rest and rest[0].kind == elements.STRAIGHT == long.kind:
        out[-1] = replace(long, length=long.length + rest[0].length)
        rest = rest[1:]
    elif rest and rest[0].kind >= elements.CLOTHOID:
        rest = [replace(rest[0], k0=long.k0, smooth=True), *rest[1:]]
    return out + rest


def without_leads(items: list[Item], length_sigma: FloatArray) -> list[Edit]:
    """Edits that leave out a transition which leads to, or from, an arc shorter than its sigma: the arc takes its place."""
    edits: list[Edit] = []
    for j, item in enumerate(items):
        if item.kind != elements.ARC or item.length > _NO_LENGTH * length_sigma[j]:
            continue
        for i in (j - 1, j + 1):
            if not 0 <= i < len(items) or items[i].kind < elements.CLOTHOID:
                continue
            whole = item.length + items[i].length
            if i < j:
                one = replace(item, length=whole, start=items[i].start, smooth=False, k0=item.k0, k1=item.k0)
                edits.append(Edit(i, j + 1, (one,), 2))
            else:
                one = replace(item, length=whole)
                rest = () if i + 1 >= len(items) else (replace(items[i + 1], smooth=False),)
                edits.append(Edit(j, i + 1 + len(rest), (one, *rest), 2))
    return edits


def _straightened(items: list[Item], j: int) -> tuple[Item, ...]:
    """Element j, an arc, as a straight, and its neighbours."""
    item = items[j]
    changed = [replace(item, kind=elements.STRAIGHT, k0=0.0, k1=0.0)]
    if j > 0:
        tied = items[j - 1].kind >= elements.CLOTHOID and item.smooth
        changed.insert(0, replace(items[j - 1], k1=0.0) if tied else items[j - 1])
    if j + 1 < len(items):
        tied = items[j + 1].kind >= elements.CLOTHOID and items[j + 1].smooth
        changed.append(replace(items[j + 1], k0=0.0) if tied else items[j + 1])
    return tuple(changed)


def smooth_joints(items: list[Item]) -> list[Edit]:
    """Edits that let curvature pass on where a transition's end jumps."""
    edits: list[Edit] = []
    for j in range(1, len(items)):
        before, item = items[j - 1], items[j]
        if item.smooth or max(before.kind, item.kind) < elements.CLOTHOID:
            continue
        if before.kind >= elements.CLOTHOID and item.kind >= elements.CLOTHOID:
            mean = 0.5 * (before.k1 + item.k0)
            pair = (replace(before, k1=mean), replace(item, k0=mean, smooth=True))
        elif before.kind >= elements.CLOTHOID:
            pair = (replace(before, k1=item.k0), replace(item, smooth=True))
        else:
            pair = (before, replace(item, k0=before.k1, smooth=True))
        if edits and edits[-1].last > j - 1:
            continue  # one at a time where they touch
        edits.append(Edit(j - 1, j + 1, pair, 1))
    return edits


def plain_transitions(items: list[Item]) -> list[Edit]:
    """Edits that make an arc of a transition whose curvatures are alike, and a straight of one that hardly bends."""
    edits: list[Edit] = []
    for j, item in enumerate(items):
        if item.kind < elements.CLOTHOID:
            continue
        lo, hi = max(j - 1, 0), min(j + 2, len(items))
        if edits and edits[-1].last > lo:
            continue
        around = items[lo:hi]
        sharp = max(max(abs(other.k0), abs(other.k1)) for other in around)
        alike = item.k0 * item.k1 > 0.0 and abs(item.k1 - item.k0) < 0.05 * max(abs(item.k0), abs(item.k1))
        flat = max(abs(item.k0), abs(item.k1)) < 0.04 * sharp
        if not (alike or flat):
            continue
        bend = 0.0 if flat else 0.5 * (item.k0 + item.k1)
        out = [replace(item, kind=elements.STRAIGHT if flat else elements.ARC, k0=bend, k1=bend)]
        before = items[j - 1] if j > 0 else None
        after = items[j + 1] if j + 1 < len(items) else None
        if (before is not None and before.kind < elements.CLOTHOID and item.smooth) or (
            after is not None and after.kind < elements.CLOTHOID and after.smooth
        ):
            # between plain elements: one of them takes its place
            if before is not None and before.kind == out[0].kind:
                out = [replace(before, length=before.length + item.length)]
                if after is not None:
                    out.append(after)
                    if after.kind == before.kind:
                        out = [replace(before, length=before.length + item.length + after.length)]
            elif after is not None and after.kind == out[0].kind:
                out = [replace(after, length=after.length + item.length, start=item.start, smooth=item.smooth)]
                if before is not None:
                    tied = before.kind >= elements.CLOTHOID and item.smooth
                    out.insert(0, replace(before, k1=after.k0) if tied else before)
            else:
                continue
            edits.append(Edit(lo, hi, tuple(out), 2))
            continue
        if before is not None:
            out.insert(0, replace(before, k1=bend) if before.kind >= elements.CLOTHOID else before)
        if after is not None:
            out.append(replace(after, k0=bend) if after.kind >= elements.CLOTHOID else after)
        edits.append(Edit(lo, hi, tuple(out), 1))
    return edits


#: Arcs shorter than this share of a run may be part of a transition, and a run has at most so many elements.
_SHORT_ARC, _LONGEST_RUN = 0.4, 7


def joined_runs(items: list[Item]) -> list[Edit]:
    """Edits that make one transition of several elements that bend further all the time, short arcs among them.

    A law that is not the clothoid's comes out of clothoids and arcs as several.
    """
    edits: list[Edit] = []
    at = 0
    while at < len(items):
        best = None
        for end in range(at + 2, min(at + _LONGEST_RUN, len(items)) + 1):
            if end < len(items) and items[end].kind >= elements.CLOTHOID and items[end].smooth and items[end].k0 != 0.0:
                continue  # a run ends at a plain element, where the track is straight, or with the track
            if _one_transition(items, at, end):
                best = end
        if best is None:
            at += 1
            continue
        run = items[at:best]
        before = items[at - 1] if at > 0 else None
        after = items[best] if best < len(items) else None
        k0 = before.k1 if before is not None and before.kind < elements.CLOTHOID else run[0].k0
        k1 = after.k0 if after is not None and after.kind < elements.CLOTHOID else run[-1].k1
        one = replace(run[0], kind=elements.CLOTHOID, length=sum(item.length for item in run), k0=k0, k1=k1)
        new = [replace(one, smooth=before is not None)]
        if after is not None:
            new.append(replace(after, smooth=True))
        unknown = sum(2 if item.kind == elements.ARC else 1 for item in run) + sum(
            item.kind >= elements.CLOTHOID and not item.smooth for item in run
        )
        edits.append(Edit(at, best + len(new) - 1, tuple(new), max(unknown - 1, 1)))
        at = best + len(new) - 1
    return edits


def _one_transition(items: list[Item], begin: int, end: int) -> bool:
    """Whether the elements from `begin` to before `end` could be one transition."""
    run = items[begin:end]
    total = sum(item.length for item in run)
    if not any(item.kind >= elements.CLOTHOID for item in run):
        return False
    if any(item.kind == elements.STRAIGHT for item in run):
        return False
    if any(item.kind == elements.ARC and item.length > _SHORT_ARC * total for item in run):
        return False
    bends = [value for item in run for value in (item.k0, item.k1)]
    if begin > 0:
        bends.insert(0, items[begin - 1].k1)
    if end < len(items):
        bends.append(items[end].k0)
    steps = np.diff(bends)
    if bends[0] * bends[-1] < 0.0:  # curves to both sides meet where the track is straight
        return False
    return bool((steps >= -1e-12).all() or (steps <= 1e-12).all())


def applied(items: list[Item], edits: list[Edit]) -> list[Item]:
    """The elements after edits that do not overlap."""
    out: list[Item] = []
    at = 0
    for edit in edits:
        out += items[at : edit.first]
        out += edit.items
        at = edit.last
    return out + items[at:]


def squares_between(fit: PlanFit, low: FloatArray, high: FloatArray) -> FloatArray:
    """Weighted squares of the points between places along the axis, (k,)."""
    square = np.append(0.0, np.cumsum(fit.square))
    return np.asarray(square[np.searchsorted(fit.along, high)] - square[np.searchsorted(fit.along, low)])
