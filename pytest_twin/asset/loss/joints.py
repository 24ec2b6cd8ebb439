"""Rows of the loss matrix on joints: kinds, limits, actuators, couplings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from pytest_twin.asset.loss.description import Description, JointFacts
from pytest_twin.asset.loss.matrix import Item, Row, Verdict
from pytest_twin.asset.loss.table import (
    EXACT,
    SINGLE,
    are_equal,
    count_and_names,
    format_numbers,
    largest_magnitude,
    table,
)


def joints(source: Description, target: Description) -> Row:
    """Compare the kind of every moving joint."""
    items = []
    for name, facts in source.joints.items():
        if name not in target.joints:
            like = [other for other in target.joints if other.startswith(f"{name}_")]
            if facts.kind in ("planar", "free") and like:
                items.append(Item(name, "changed", facts.kind, " ".join(like)))
            elif facts.kind == "free":
                items.append(Item(name, "changed", "free", "a body without a joint"))
            else:
                items.append(Item(name, "lost", facts.kind, None))
        elif target.joints[name].kind != facts.kind:
            items.append(Item(name, "changed", facts.kind, target.joints[name].kind))
    return table(
        "joints that move",
        f"{len(source.joints)}",
        f"{len(target.joints)}",
        "kind of each joint of the compiled model",
        items,
        empty=not source.joints,
        critical=any(item.verdict == "lost" for item in items),
    )


def degrees_of_freedom(source: Description, target: Description) -> Row:
    """Compare degrees of freedom minus those that couplings remove."""
    verdict: Verdict = "kept" if source.independent == target.independent else "changed"
    return Row(
        "independent degrees of freedom",
        verdict,
        str(source.independent),
        str(target.independent),
        "degrees of freedom less the rank of their couplings",
    )


def passive_joints(source: Description, target: Description) -> Row:
    """Compare joints without actuator and mimic."""
    items = [
        Item(name, "changed", "driven", "passive")
        for name in sorted((target.passive - source.passive) & set(source.joints))
    ] + [
        Item(name, "changed", "passive", "driven")
        for name in sorted((source.passive - target.passive) & set(target.joints))
    ]
    return table(
        "passive joints",
        count_and_names(source.passive),
        count_and_names(target.passive),
        "joints without actuator and mimic",
        items,
        empty=not source.passive and not target.passive,
    )


def actuators(source: Description, target: Description) -> Row:
    """Compare joint, gear and force range of each actuator."""
    items = []
    held = {joint: (gear, bound) for joint, gear, bound in target.actuators.values()}
    for joint, gear, bound in source.actuators.values():
        if joint not in held:
            items.append(Item(joint, "lost", _actuator(gear, bound), None))
        elif not are_equal(bound, held[joint][1]) or abs(held[joint][0] - gear) > EXACT:
            items.append(Item(joint, "changed", _actuator(gear, bound), _actuator(*held[joint])))
    return table(
        "actuators",
        f"{len(source.actuators)} driven joints",
        f"{len(target.actuators)} actuators",
        "joint, gear and force range of each actuator",
        items,
        empty=not source.actuators and not target.actuators,
    )


def _actuator(gear: float, bound: tuple[float, float] | None) -> str:
    words = "no bound" if bound is None else f"{bound[0]:g} to {bound[1]:g} N*m or N"
    return words if gear == 1.0 else f"{words}, gear {gear:g}"


def limits(source: Description, target: Description) -> Iterable[Row]:
    """Yield rows for position, velocity and effort limits."""
    readers: dict[str, tuple[Callable[[JointFacts], Any], str, str]] = {
        "position limits": (lambda facts: facts.range, "rad or m", "range of each joint"),
        "velocity limits": (lambda f: f.velocity, "rad/s or m/s", "velocity limit of each joint"),
        "effort limits": (
            lambda facts: facts.effort,
            "N*m or N",
            "largest force on each joint, with every control beyond its bounds"
            if target.name == "MJCF"
            else "effort limit of each joint",
        ),
    }
    for feature, (read, unit, comparison) in readers.items():
        items = []
        stated = kept = 0
        worst = 0.0
        for name, facts in source.joints.items():
            if name not in target.joints:
                continue
            before, after = read(facts), read(target.joints[name])
            stated += before is not None
            kept += after is not None
            if before is not None and after is not None:
                worst = max(worst, largest_magnitude(np.subtract(before, after)))
            if are_equal(before, after):
                continue
            verdict: Verdict = "lost" if after is None else "changed"
            items.append(Item(name, verdict, _value(before, unit), _value(after, unit)))
        row = table(
            feature,
            f"{stated} stated",
            f"{kept} held",
            comparison,
            items,
            empty=not stated and not kept,
        )
        yield Row(
            row.feature,
            row.verdict,
            row.before,
            row.after,
            row.comparison,
            worst,
            EXACT,
            unit,
            row.items,
        )


def _value(value: Any, unit: str) -> str | None:
    return None if value is None else f"{format_numbers(value)} {unit}"


def passive_terms(source: Description, target: Description) -> Row:
    """Compare damping and friction of each joint."""
    items = []
    stated = 0
    for name, facts in source.joints.items():
        held = target.joints.get(name)
        for what in ("damping", "friction"):
            before = float(getattr(facts, what))
            stated += before != 0.0
            if held is None:
                continue
            after = float(getattr(held, what))
            if not are_equal(before, after):
                verdict: Verdict = "lost" if after == 0.0 else "changed"
                items.append(Item(f"{name} {what}", verdict, f"{before:g}", f"{after:g}"))
    return table(
        "damping and friction",
        f"{stated} stated",
        f"{stated - sum(item.verdict == 'lost' for item in items)} held",
        "coefficients of each joint of the compiled model",
        items,
        empty=not stated and not items,
    )


def mimics(source: Description, target: Description) -> Row:
    """Compare the law of each mimic; a changed law is critical."""
    items = []
    for name, law in source.mimics.items():
        held = target.mimics.get(name)
        if held is None:
            items.append(Item(name, "lost", _law(law), "independent"))
        elif held[0] != law[0] or not np.allclose(held[1:], law[1:], rtol=SINGLE, atol=SINGLE):
            items.append(Item(name, "changed", _law(law), _law(held)))
    comparison = (
        "residual of each constraint with its leader moved by 1 rad or m"
        if target.name == "MJCF"
        else "follower, leader, multiplier and offset in the model"
    )
    return table(
        "mimic",
        count_and_names(source.mimics),
        count_and_names(target.mimics),
        comparison,
        items,
        empty=not source.mimics and not target.mimics,
        critical=any(item.verdict == "changed" for item in items),
    )


def _law(law: tuple[str, float, float]) -> str:
    return f"{law[1]:g} * {law[0]} + {law[2]:g}"


def constraints(source: Description, target: Description) -> Row:
    """Compare tendons and constraints other than mimics."""
    before, after = list(source.constraints), list(target.constraints)
    items = [Item(word, "lost", word, None) for word in before if word not in after]
    items += [Item(word, "changed", None, word) for word in after if word not in before]
    return table(
        "tendons and constraints",
        count_and_names(before),
        count_and_names(after),
        "constraints of the compiled model, mimics apart",
        items,
        empty=not before and not after,
    )


def transmissions(source: Description, target: Description) -> Row:
    """Compare the gear of each actuator with a transmission."""
    items = []
    for joint, words in source.transmissions.items():
        if joint not in target.transmissions:
            items.append(Item(joint, "lost", words, None))
        elif _reduction(words) != _reduction(target.transmissions[joint]):
            items.append(Item(joint, "changed", words, target.transmissions[joint]))
    return table(
        "transmissions",
        count_and_names(source.transmissions),
        f"{len(target.transmissions)} gears",
        "gear of the actuator on each joint",
        items,
        empty=not source.transmissions,
    )


def _reduction(words: str) -> float:
    _, _, number = words.partition("reduction ")
    try:
        return float(number)
    except ValueError:
        return 1.0
