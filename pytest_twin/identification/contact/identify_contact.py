"""Run one contact identification, from its files to the fitted model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.formats.pose_tracks import holds_tosses
from pytest_twin.identification.contact.document import contact_document
from pytest_twin.identification.contact.fit import ContactFit, fit_contact
from pytest_twin.identification.contact.parameters import contact_model, geom_patch, pair_patch
from pytest_twin.identification.contact.roles import TossOptions, read_by_role
from pytest_twin.identification.document import nominal_document
from pytest_twin.identification.write import write_fitted
from pytest_twin.realization import Realization
from pytest_twin.realization.free_body import free_body
from pytest_twin.realization.patch import keep_inertia
from pytest_twin.time_limit import skips


def are_tosses(recordings: Sequence[Path], options: TossOptions) -> bool:
    """Whether recordings contain poses of an object: archives, or bags with a named pose topic."""
    return options.topic is not None or all(holds_tosses(path) for path in recordings)


def identify_contact(
    realization: Realization,
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    options: TossOptions,
    folder: Path,
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Fit the contact of a free body, and write the fitted model.

    Args:
        recordings, held_out: archives of tosses and bags.
        options: settings for reading the tosses.
        folder: empty folder for the fitted model.
        progress: called with the fraction done.

    Returns:
        The content of ``identification.json`` without its inputs.

    Raises:
        TwinError: the input cannot be used.
    """
    body = free_body(realization, options.body)
    gravity = np.array(realization.model.opt.gravity)
    tosses = read_by_role(
        recordings, held_out, gravity, body, np.array(realization.model.body_ipos[body.body]),
        options,
    )  # fmt: skip
    if skips("stage contact"):
        document = nominal_document("poses of tosses")
        document["notes"] += tosses.notes
        write_fitted(folder, realization)
        return document
    fit = fit_contact(contact_model(realization, body), tosses.fit, tosses.held_out, progress)
    document = contact_document(fit, tosses, realization)
    model = realization.model
    for kind, unnamed in (
        ("geoms", sum(not model.geom(g).name for g in body.geoms)),
        ("declared pairs", sum(not model.pair(p).name for p in body.pairs)),
    ):
        if unnamed:
            document["notes"].append(
                f"{unnamed} {kind} of {body.name} have no name: realization/ has their fit, fit: "
                "of a twin cannot; name them to list the record there"
            )
    document["notes"] = [*tosses.notes, *document["notes"]]
    document["trials"] = {
        "fit": list(dict.fromkeys(one.path.name for one in tosses.fit)),
        "held_out": list(dict.fromkeys(one.path.name for one in tosses.held_out)),
    }
    document["contact"]["tosses"] = {
        "fit": [one.name for one in tosses.fit],
        "held_out": [one.name for one in tosses.held_out],
        "length_unit": tosses.units.length,
        "rate": None if tosses.units.period is None else 1.0 / tosses.units.period,
        "velocity_age": tosses.units.lag,
    }
    write_fitted(folder, _with_contact(realization, fit))
    return document


def _with_contact(realization: Realization, fit: ContactFit) -> Realization:
    """Return the realization with the fitted values, also of geoms and pairs without names."""
    spec = realization.spec.copy()
    model = realization.model
    body, values = fit.contact.body, fit.values
    geoms, pairs = ({int(one.id): one for one in some} for some in (spec.geoms, spec.pairs))
    patches = [(geoms[g], geom_patch(model, body, g, values)) for g in body.geoms]
    patches += [(pairs[p], pair_patch(model, p, values)) for p in body.pairs]
    keep_inertia(spec, [geoms[g].parent for g in body.geoms])
    for element, patch in patches:
        for name, value in patch.items():
            setattr(element, name, value)
    return Realization(
        name=realization.name,
        path=realization.path,
        spec=spec,
        model=spec.compile(),
        source=realization.source,
        twin=realization.twin,
    )
