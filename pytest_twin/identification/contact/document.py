"""Content of ``identification.json`` for a contact identification."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from pytest_twin import __version__
from pytest_twin.estimation.covariance import correlated_pairs
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.contact.fit import ContactFit
from pytest_twin.identification.contact.loss import TossErrors, losses
from pytest_twin.identification.contact.parameters import (
    DAMPING,
    FRICTION,
    ROLLING,
    STIFFNESS,
    TORSIONAL,
    UNITS,
    geom_patch,
    pair_patch,
)
from pytest_twin.identification.contact.restitution import restitution_of
from pytest_twin.identification.contact.roles import TossSet
from pytest_twin.identification.document import nominal_document, verdict_of
from pytest_twin.identification.stages import HeldOut, Stage, judge_stage
from pytest_twin.realization import Realization

_MOTION = {
    FRICTION: "push the object along the surface so that it slides, with a measured force; or toss",
    TORSIONAL: "spin the object about the normal while one face or one point lies on the surface",
    ROLLING: "let the object roll on the surface until it stops",
    STIFFNESS: "press the object onto the surface with two known forces and measure how far it "
    "sinks in, or record impacts at 1 kHz or more",
    DAMPING: "drop the object flat from several heights and record the rebound at 1 kHz or more",
}
_ANY_MOTION = "toss the object so that it lands on corners, edges and faces at several speeds"


def contact_document(fit: ContactFit, tosses: TossSet, realization: Realization) -> dict[str, Any]:
    """Return the content of ``identification.json``, without inputs and notes of the run."""
    body, size = fit.contact.body.name, fit.contact.size
    values = fit.values
    deviation = np.sqrt(np.diag(fit.covariance).clip(0.0))
    names = [f"{body}.{name}" for name in fit.names]
    nominal = {one.name: one.start for one in fit.contact.parameters}
    stage = Stage(
        "contact",
        "accepted",
        f"fitted to {len(tosses.fit)} whole tosses",
        tuple(names),
        excludes="a wrong first state: each toss starts from its measured pose and velocity",
    )
    held = bool(tosses.held_out)
    before, after = (
        losses(one, size)
        for one in ((fit.nominal_held, fit.fitted_held) if held else (fit.nominal, fit.fitted))
    )
    if held:
        stage = judge_stage(
            stage, HeldOut(float(before.mean()), float(after.mean()), "half widths plus rad")
        )
    model = fit.contact.model
    return {
        **nominal_document(f"whole tosses of {body}"),
        "verdict": verdict_of([stage], bool(after.mean() < before.mean()), held, True),
        "tested_on": f"{len(tosses.held_out)} held-out tosses" if held else "the fit tosses",
        "stages": [stage.to_json()],
        "parameters": {
            f"{body}.{name}": {
                "value": values[name],
                "unit": UNITS[name],
                "ci95": _interval(fit, name, one, values[name]),
                "ci95_over_simulations": _over_simulations(fit, name, one),
                "prior": nominal[name],
                "stage": "contact",
            }
            for name, one in zip(fit.names, deviation.tolist(), strict=True)
        },
        "covariance": {"names": names, "matrix": fit.covariance.tolist()},
        "held_out": {
            body: _errors(
                fit.fitted_held if held else fit.fitted,
                fit.nominal_held if held else fit.nominal,
                size,
            )
        },
        "fitted": {body: _errors(fit.fitted, fit.nominal, size)},
        "unobservable": [*_undetermined_entries(fit, body), *_without_effect(fit, body)],
        "contact": {
            "pair": {
                "object": [_name(model, geom) for geom in fit.contact.body.geoms],
                "surroundings": [_name(model, geom) for geom in fit.contact.body.others],
            },
            "held": {f"{body}.{one.fixed}": one.value for one in fit.undetermined},
            "from": "whole tosses" if fit.is_refined else f"{_samples()}-sample stretches",
            "restitution": restitution_of(fit),
            "solver": solver_of(model),
            "spread": [
                {
                    "simulation": one.name,
                    "parameters": {f"{body}.{name}": v for name, v in one.values.items()},
                    "held_out": _errors(one.held, None, size) if held else None,
                    "held_out_with_these_parameters": _errors(one.kept, None, size)
                    if held
                    else None,
                }
                for one in fit.variants
            ],
        },
        "fit": _model_changes(fit, realization),
        "correlated": correlated_pairs(names, fit.covariance),
        "software": {"pytest-twin": __version__, "mujoco": mujoco.__version__},
    }


def _interval(fit: ContactFit, name: str, deviation: float, at: float) -> list[float]:
    """95 % interval around a value; symmetric in the logarithm if that was estimated.

    Args:
        deviation: standard deviation at the fitted value.
        at: fitted value, or that of another simulation.
    """
    (parameter,) = (one for one in fit.contact.parameters if one.name == name)
    if not parameter.is_logarithmic:
        return [at - Z95 * deviation, at + Z95 * deviation]
    factor = float(np.exp(Z95 * deviation / fit.values[name]))
    return [at / factor, at * factor]


def _over_simulations(fit: ContactFit, name: str, deviation: float) -> list[float]:
    """Interval that also holds the estimates with another time step and integrator.

    An estimate belongs to the simulation that it was made with. The interval says how far it holds
    for the object. Another friction cone is another law, so it is left out.
    """
    numerical = [one for one in fit.variants if not one.is_another_law]
    centres = [fit.values[name], *(one.values[name] for one in numerical)]
    ends = [_interval(fit, name, deviation, at) for at in centres]
    return [min(low for low, _ in ends), max(high for _, high in ends)]


def solver_of(model: mujoco.MjModel) -> dict[str, Any]:
    """Return the simulation options for which a contact fit is valid."""
    option = model.opt
    return {
        "engine": f"mujoco {mujoco.__version__}",
        "timestep": float(option.timestep),
        "integrator": mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_"),
        "solver": mujoco.mjtSolver(option.solver).name.removeprefix("mjSOL_"),
        "cone": mujoco.mjtCone(option.cone).name.removeprefix("mjCONE_"),
        "iterations": int(option.iterations),
        "tolerance": float(option.tolerance),
        "impratio": float(option.impratio),
    }


def _samples() -> int:
    from pytest_twin.identification.contact.fit import SAMPLES

    return SAMPLES


def _errors(errors: TossErrors, nominal: TossErrors | None, size: float) -> dict[str, Any]:
    found: dict[str, Any] = {
        "toss_position": float(errors.position.mean()),
        "toss_position_unit": "m",
        "toss_position_widths": float(errors.position.mean()) / (2.0 * size),
        "toss_rotation": float(errors.rotation.mean()),
        "toss_rotation_unit": "rad",
        "tosses": len(errors.position),
    }
    if nominal is not None:
        found["toss_position_nominal"] = float(nominal.position.mean())
        found["toss_rotation_nominal"] = float(nominal.rotation.mean())
    return found


def _undetermined_entries(fit: ContactFit, body: str) -> list[dict[str, str]]:
    found = []
    for one in fit.undetermined:
        leading = sorted(one.loadings.items(), key=lambda pair: -abs(pair[1]))
        terms = [f"{share:+.2f} {body}.{name}" for name, share in leading if abs(share) > 0.1]
        found.append(
            {
                "expression": " ".join(terms) + " (on the scales of the search)",
                "motion": _MOTION.get(one.fixed, _ANY_MOTION),
            }
        )
    return found


def _without_effect(fit: ContactFit, body: str) -> list[dict[str, str]]:
    return [
        {"expression": f"{body}.{name}", "motion": _MOTION[name]} for name in fit.without_effect
    ]


def _model_changes(fit: ContactFit, realization: Realization) -> dict[str, Any]:
    """Return the changes of the record to the model: attributes of named geoms and pairs."""
    model, body, values = realization.model, fit.contact.body, fit.values
    geoms = {_name(model, g): geom_patch(model, body, g, values) for g in body.geoms}
    pairs = {str(model.pair(p).name): pair_patch(model, p, values) for p in body.pairs}
    families = {"geom": geoms, "pair": pairs}
    named = {
        family: {name: patch for name, patch in own.items() if name and patch}
        for family, own in families.items()
    }
    return {family: own for family, own in named.items() if own}


def _name(model: mujoco.MjModel, geom: int) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or ""
