"""Run one calibration, from its files to the content of ``calibration.json``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.calibration.basis import calibration_basis
from pytest_twin.calibration.cameras.half_turn import with_consistent_orientation
from pytest_twin.calibration.cameras.image_refinement import ImageRefinement, calibrate_intrinsics
from pytest_twin.calibration.cameras.images import Images, read_images
from pytest_twin.calibration.changed_cell import changed_cell
from pytest_twin.calibration.clocks.calibrate_streams import calibrate_streams
from pytest_twin.calibration.coincident_markers import ExcludedMeasurement, without_coincident
from pytest_twin.calibration.compliance import Compliance, with_compliance
from pytest_twin.calibration.conditions import add_conditions, conditions_of
from pytest_twin.calibration.document import new_document
from pytest_twin.calibration.encoders import ENCODERS, calibrate_encoders
from pytest_twin.calibration.error_sources import weigh_by_source
from pytest_twin.calibration.input_mistake import InputMistake
from pytest_twin.calibration.input_mistakes import find_mistakes, has_large_errors
from pytest_twin.calibration.next_poses import next_poses, pose_diversity
from pytest_twin.calibration.observability import (
    Gauge,
    hold_gauges,
    uncertain_directions,
    undetermined_directions,
    untested_directions,
)
from pytest_twin.calibration.observations import Observations, in_order
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.plan import Plan, load_plan
from pytest_twin.calibration.pose_errors import TestedPoses, with_pose_errors
from pytest_twin.calibration.problem import CalibrationProblem, make_problem, reported_flange
from pytest_twin.calibration.reach_hypotheses import hypotheses_in_words, reach_hypotheses
from pytest_twin.calibration.recordings.gather import GatheredObservations, gather
from pytest_twin.calibration.records import (
    TARGET_SCALE,
    CalibrationEstimate,
    estimate,
    full_covariance,
    records,
    size_note,
    solver_transforms,
    with_directions,
)
from pytest_twin.calibration.repeated_rows import without_repeats
from pytest_twin.calibration.residual_errors import Errors, acceptance_failures, errors_of, pattern
from pytest_twin.calibration.scene import scene
from pytest_twin.calibration.solve import LEAST_INLIERS, Fit, robust_cost, solve
from pytest_twin.calibration.solver_comparison import (
    LEAST_SQUARES,
    BetterSolver,
    better_solver,
)
from pytest_twin.calibration.split import split
from pytest_twin.calibration.starts import camera_unit, is_subset, starts
from pytest_twin.calibration.wrong_scale import FreeScale, wrong_scale
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.realization.serial_chain import SerialChain, load_serial_chain
from pytest_twin.time_limit import is_over, limited

_MOST_OUTLIERS = 0.25
"""Fraction of the fitted measurements that may be left out of an accepted calibration."""

GROSS_RATIO = 6.0
"""A held-out observation is excluded only if its error exceeds that of the best third of the
held-out ones by this factor. A target that was not detected correctly does not test the
calibration. Poor predictions of the calibration raise the best third too and are kept."""


@dataclass(frozen=True)
class Solution:
    """Solution of a problem on the fitted observations.

    Attributes:
        estimate: estimate with covariance and undetermined directions.
        gauges: joint zeros that were fixed.
        candidates: algebraic solver -> its state.
        sources: error source -> standard deviation, m or rad; empty if the sources cannot be
            distinguished.
        compliance: bending of the arm under gravity, if the residuals show it.
        poses: errors that repeat with the pose.
    """

    estimate: CalibrationEstimate
    gauges: tuple[Gauge, ...]
    candidates: Mapping[str, State]
    sources: Mapping[str, float]
    compliance: Compliance | None
    poses: TestedPoses

    @property
    def notes(self) -> list[str]:
        """What the user has to know of the solution."""
        return [] if self.compliance is None else [self.compliance.words]


def calibrate_file(
    plan: str,
    progress: Callable[[float], None] | None = None,
    folder: str | None = None,
    record_folder: str | None = None,
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Return the content of ``calibration.json`` for the plan in a file.

    At the time limit and at a stop request of the parent, the best values so far are returned.

    Args:
        progress: called with the fraction done, 0 to 1.
        folder: folder that keeps observations and images of recordings; by default they are
            deleted.
        record_folder: folder that the record will be in; by default that of the plan.
        seconds: limit of the processor time, s; 0 for none.

    Raises:
        TwinError: the input cannot be used.
    """
    told = progress or (lambda fraction: None)
    found = load_plan(Path(plan))
    record_in = Path(record_folder or found.path.parent)
    with contextlib.ExitStack() as stack:
        limit = stack.enter_context(limited(seconds))
        place = folder or stack.enter_context(temporary_folder())
        document = _calibrate_plan(found, Path(place), told)
    if limit.reason:
        note = limit.note("These are the best values so far, and not all checks were made")
        document["reasons"] = [note, *document["reasons"]]
        if document["verdict"] == "accepted":
            document["verdict"] = "rejected"
    document["basis"] = calibration_basis(found, document["inputs"], record_in)
    return document


def _calibrate_plan(found: Plan, folder: Path, told: Callable[[float], None]) -> dict[str, Any]:
    if found.streams:
        if found.has_free_scale:
            raise found.error(
                "camera.scale",
                "the scale cannot be estimated from streams on two clocks",
                value="estimate",
                expected="observations: poses at rest, or at stamps of one clock",
            )
        document = calibrate_streams(found)
        document["inputs"] = _inputs(found, [found.path, *found.streams.values()])
        return document
    if not found.observations:
        raise found.error(
            "observations", "no observations", expected="observations: observations.csv"
        )
    return _calibrate_observations(found, folder, told)


def _calibrate_observations(
    found: Plan, folder: Path, told: Callable[[float], None]
) -> dict[str, Any]:
    gathered = gather(found, folder)
    observations = gathered.observations
    chain = None
    if found.robot is not None and observations.joints:
        chain = load_serial_chain(found.robot, found.flange)
    if ENCODERS in found.estimate:
        document = calibrate_encoders(found, observations, chain)
        document["inputs"] = _inputs(found, _read_files(found, gathered, folder))
        return document
    observations = in_order(observations, is_motion=found.has_free_scale)
    observations, images, rejected = read_images(
        found, observations, folder, lambda fraction: told(0.1 + 0.3 * fraction)
    )
    rejected = (*gathered.left_out, *rejected)
    told(0.4 if images else 0.1)
    if images is not None and set(found.estimate) == {"intrinsics"}:
        document = calibrate_intrinsics(found, observations, images, rejected)
    else:
        document = calibrate(found, observations, chain, told, images, rejected)
    files = _read_files(found, gathered, folder)
    if images is not None:
        files += images.paths
    document["inputs"] = _inputs(found, files)
    return document


def _read_files(plan: Plan, gathered: GatheredObservations, folder: Path) -> list[Path]:
    robot = [plan.robot] if plan.robot else []
    files = [plan.path, *_files(plan.observations), *robot]
    return files + [one for one in gathered.tables if one not in files and folder.is_dir()]


def _files(paths: Sequence[Path]) -> list[Path]:
    """Return the files, with folders of bags replaced by the files in them."""
    return [
        file
        for path in paths
        for file in (sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path])
    ]


def _inputs(plan: Plan, paths: Sequence[Path]) -> dict[str, Any]:
    """Return the digest of each file, by its path relative to the plan's folder."""
    folder = plan.path.parent
    return {
        str(path.relative_to(folder) if path.is_relative_to(folder) else path): {
            "sha256": file_sha256(path)
        }
        for path in paths
    }


def calibrate(
    plan: Plan,
    observations: Observations,
    chain: SerialChain | None,
    progress: Callable[[float], None] = lambda fraction: None,
    images: Images | None = None,
    rejected: Sequence[ExcludedMeasurement] = (),
) -> dict[str, Any]:
    """Return the content of ``calibration.json`` for observations in memory.

    Args:
        chain: kinematic chain of the robot; None if flange poses are given.
        progress: called with the fraction done, 0 to 1.
        images: images of the observations, if any.

    Raises:
        TwinError: the observations cannot be used.
    """
    if images is not None and plan.has_free_scale:
        raise plan.error(
            "camera.scale",
            "the scale cannot be estimated with images of a target of known size",
            value="estimate",
            expected="no scale, or camera_from_target in place of images",
        )
    observations, left_out = without_coincident(observations)
    observations, repeats = without_repeats(plan, observations, images)
    left_out += repeats
    unused = [one.id for one in (*rejected, *left_out)]
    fit_rows, held_rows = split(plan, observations, unused)
    turned = ""
    if images is not None and (flange := reported_flange(chain, observations)) is not None:
        images, turned = with_consistent_orientation(images, observations.ids, flange)
    seen = None if images is None else ImageRefinement(images, observations, fit_rows)
    if seen is not None and turned:
        seen.notes.append(turned)
    if seen is not None:
        observations = seen.posed(observations)
    progress(0.5)
    problem = make_problem(plan, observations, chain)
    if plan.has_free_scale:
        unit = camera_unit(problem.on_rows(fit_rows))
        problem = problem.in_unit(unit or 1.0)
    solved = solve_problem(problem.on_rows(fit_rows))
    progress(0.6)
    if seen is not None and seen.refine(solved.estimate):
        refined = seen.estimate
        wider = refined.covariance + solved.poses.added
        solved = replace(solved, estimate=replace(refined, covariance=wider))
        problem = make_problem(plan, seen.posed(observations), chain)
    progress(0.7)
    fit = solved.estimate.fit
    problem = replace(problem, layout=fit.problem.layout)
    held = problem.on_rows(held_rows)
    document = {**new_document(plan), "records": records(solved.estimate)}
    # Rates are differences between neighbours in time, including held-out ones.
    everywhere = errors_of(problem, fit.state)
    of_all = everywhere.only(np.isin(everywhere.rows, held_rows))
    errors, gross = without_gross_errors(of_all)
    fitted = errors_of(fit.problem, fit.state, fit.kept)
    degenerate = bool(solved.estimate.directions)
    held_ids = [problem.observations.ids[row] for row in held_rows]
    document["held_out"] = {**_errors_json(errors, observations.payloads), "ids": held_ids}
    _add_hypotheses(document["held_out"].get("pattern"), fit, held, errors)
    if gross:
        document["held_out"]["with_excluded"] = of_all.summary()
    document["fitted"] = _fitted_json(solved, fitted)
    document["solvers"], better = _solvers(held, solved, errors)
    document["excluded"] = [
        one.to_json() for one in (*rejected, *left_out, *_outliers(fit), *gross)
    ]
    document["unobservable"] = [
        *(direction.words for direction in solved.estimate.directions),
        *(gauge.words for gauge in solved.gauges),
    ]
    lost = [] if seen is None else seen.complete(document, held_rows)
    document["unobservable"] += lost
    add_conditions(document, conditions_of(problem))
    degenerate = degenerate or bool(lost)
    change = None if degenerate or is_over() else changed_cell(problem, fit)
    suspected: tuple[InputMistake, ...] = ()
    if change is not None and not change.may_be_arm:
        suspected = (change.mistake,)
    else:
        suspected = _suspected(fit, document, None if seen is None else seen.scale)
    document["suspected"] = [one.to_json() for one in suspected]
    reasons = [
        *(f"{one.what}; {one.mend}" for one in suspected),
        *(() if suspected else _many_outliers(fit)),
        *acceptance_failures(
            errors.summary() if errors.ids else solved.estimate.leave_one_out, asdict(plan.accept)
        ),
    ]
    notes = [*problem.notes, *(() if seen is None else seen.notes), *_notes(plan, held)]
    notes += solved.notes
    # A mistake of the input has errors that follow the poses too.
    notes += [] if suspected else [one.words for one in solved.poses.errors]
    if not degenerate:
        notes += _note_on_inverses(problem, document["records"])
        notes += [
            f"the held-out observations do not test everything: with them alone, {words}; hold "
            "out others (hold_out: {seed: ...})"
            for words in untested_directions(fit, held)
        ]
    if change is not None and change.may_be_arm:
        notes.append(change.note)
    # Poses that determine nothing compare no solvers.
    if better is not None and not degenerate:
        is_reason = better.is_beyond_chance and not suspected
        (reasons if is_reason else notes).append(better.words)
    if degenerate and not suspected:
        document["verdict"] = "degenerate"
    else:
        document["verdict"] = "rejected" if reasons or degenerate else "accepted"
    directions = [*(direction.words for direction in solved.estimate.directions), *lost]
    # A mistake in the input makes directions seem undetermined; further poses would not help.
    document["reasons"] = reasons if suspected else [*directions, *reasons]
    if TARGET_SCALE in document["records"] and (note := size_note(plan)):
        notes.append(note)
    document["notes"] = notes
    document["covariance"] = full_covariance(solved.estimate)
    document["scene"] = scene(
        problem, fit.state, {"held_out": (problem, errors), "fitted": (fit.problem, fitted)}
    )
    document["pose_diversity"] = pose_diversity(fit.problem, solved.estimate)
    document["next_poses"] = next_poses(solved.estimate)
    progress(1.0)
    return document


def solve_problem(problem: CalibrationProblem) -> Solution:
    """Return the best solution of a problem over all starts.

    Raises:
        SpecError: too few observations for any start.
    """
    candidates = starts(problem)
    if not candidates:
        # With too few poses for an algebraic solver, the undetermined directions tell what is
        # missing.
        candidates = {"nominal": problem.fixed}
    cost = {name: robust_cost(problem, state) for name, state in candidates.items()}
    best = candidates[min(cost, key=lambda name: cost[name])]
    problem, gauges = hold_gauges(problem, best)
    fit = solve(problem, best)
    directions = undetermined_directions(fit)
    found = estimate(fit, directions)
    if not directions:
        found = with_directions(found, uncertain_directions(fit, found.covariance, found.quantile))
    found, sources = weigh_by_source(found)
    found, compliance = with_compliance(found)
    found, poses = with_pose_errors(found)
    kept = {name: state for name, state in candidates.items() if not is_subset(name)}
    return Solution(found, gauges, kept, sources, compliance, poses)


def _suspected(
    fit: Fit, document: dict[str, Any], of_corners: FreeScale | None
) -> tuple[InputMistake, ...]:
    """Return the mistakes of the input that would explain the errors."""
    if is_over():
        return ()
    if has_large_errors(document["fitted"], fit.problem):
        return find_mistakes(fit, of_corners)
    # A wrong size of the target moves the camera, and the errors may stay small.
    scale = wrong_scale(fit, of_corners)
    return () if scale is None else (scale,)


def _add_hypotheses(
    shape: dict[str, Any] | None, fit: Fit, held: CalibrationProblem, errors: Errors
) -> None:
    """Add possible causes to the pattern of errors that grow with reach."""
    if shape is not None and shape["kind"] == "grows_with_reach" and not is_over():
        shape["hypotheses"] = reach_hypotheses(fit, held, errors)
        shape["words"] += f". {hypotheses_in_words(shape['hypotheses'])}"


def without_gross_errors(errors: Errors) -> tuple[Errors, tuple[ExcludedMeasurement, ...]]:
    """Exclude gross errors from held-out ones; return the rest and what was excluded."""
    if len(errors.ids) < 4:
        return errors, ()
    angles = np.linalg.norm(errors.rotation, axis=1)
    parts = [errors.distance, *([angles] if np.isfinite(angles).all() else [])]
    sizes = [one / max(float(np.quantile(one, LEAST_INLIERS)), 1e-12) for one in parts]
    gross = np.max(sizes, axis=0) > GROSS_RATIO
    if not gross.any():
        return errors, ()
    left_out = tuple(
        ExcludedMeasurement(
            errors.ids[at],
            f"held out; {1e3 * errors.distance[at]:.3g} mm off, more than {GROSS_RATIO:.0f} times "
            "the best third of the held-out observations",
        )
        for at in np.flatnonzero(gross)
    )
    return errors.only(~gross), left_out


def _fitted_json(solved: Solution, fitted: Errors) -> dict[str, Any]:
    """Errors of the fitted observations, and what their residuals show."""
    found: dict[str, Any] = {**fitted.summary(), "noise": dict(solved.estimate.fit.noise)}
    if solved.sources:
        found["error_sources"] = dict(solved.sources)
    if solved.compliance is not None:
        found["compliance"] = solved.compliance.to_json()
    if solved.poses.errors:
        found["pose_errors"] = [one.to_json() for one in solved.poses.errors]
    found["leave_one_out"] = dict(solved.estimate.leave_one_out)
    return found


def _errors_json(errors: Errors, payloads: Sequence[str] | None) -> dict[str, Any]:
    found = errors.summary()
    if errors.ids:
        found["worst"] = errors.worst()
        found["regions"] = errors.regions()
        found["pattern"] = pattern(errors, payloads)
    return found


def _solvers(
    held: CalibrationProblem, solved: Solution, errors: Errors
) -> tuple[dict[str, Any], BetterSolver | None]:
    """Return the held-out errors of each solver, and one that is better than least squares."""
    chosen = set(errors.ids)
    each = {}
    for name, state in solved.candidates.items():
        mine = errors_of(held, state)
        each[name] = mine.only(np.array([one in chosen for one in mine.ids], dtype=bool))
    each[LEAST_SQUARES] = errors
    figures = ("translation_rms", "rotation_rms")
    found: dict[str, Any] = {
        name: {k: v for k, v in one.summary().items() if k in figures} for name, one in each.items()
    }
    better = better_solver({name: one.distance for name, one in each.items()})
    if better is not None and better.is_beyond_chance:
        found[better.name]["transforms"] = solver_transforms(
            solved.estimate, solved.candidates[better.name]
        )
    return found, better


def _outliers(fit: Fit) -> list[ExcludedMeasurement]:
    found = []
    for term, kept, residual in zip(fit.problem.terms, fit.kept, fit.residuals, strict=True):
        for at in np.flatnonzero(~kept):
            off = f"{1e3 * np.linalg.norm(residual[at, :3]):.3g} mm"
            usual = 1e3 * fit.noise[term.noise[0]]
            words = f"{term.name} is {off}"
            if len(term.noise) == 6:
                words += f" and {1e3 * np.linalg.norm(residual[at, 3:]):.3g} mrad"
            found.append(
                ExcludedMeasurement(
                    fit.problem.observations.ids[term.rows[at]],
                    f"outlier: {words} from the fit to the others, whose standard deviation is "
                    f"{usual:.3g} mm",
                )
            )
    return found


def _many_outliers(fit: Fit) -> list[str]:
    """Return the reason to reject a fit that leaves out a large part of the measurements."""
    left_out = [int((~kept).sum()) for kept in fit.kept]
    return [
        f"{count} of {len(kept)} measurements of {term.name} do not agree with the others: what is "
        "wrong with them may be wrong with all; see excluded"
        for term, kept, count in zip(fit.problem.terms, fit.kept, left_out, strict=True)
        if count > _MOST_OUTLIERS * len(kept)
    ]


def _note_on_inverses(problem: CalibrationProblem, found: Mapping[str, Any]) -> list[str]:
    """A note if flange and camera poses may both be inverted.

    With A the flange in the base and B the target in the camera, A X B = Z. The inverses of A and B
    fit as well, and exchange X and Z: only their sizes show which is which.
    """
    columns = problem.observations
    if problem.plan.mount != "hand" or problem.chain is not None or columns.images is not None:
        return []
    if columns.camera_from_target is None or not {"hand_eye", "base_world"} <= set(found):
        return []
    from_flange, from_base = (
        1e3 * float(np.linalg.norm(found[record]["transform"]["xyz"]))
        for record in ("hand_eye", "base_world")
    )
    if from_flange <= from_base:
        return []
    return [
        f"the camera is {from_flange:.3g} mm from the flange, and the target {from_base:.3g} mm "
        "from the base: if it is the other way round, flange.* and camera_from_target are both "
        "inverted, which fits as well; invert both, so that they are the flange in the base and "
        "the target in the camera"
    ]


def _notes(plan: Plan, held: CalibrationProblem) -> list[str]:
    found = []
    if len(held.observations) == 0:
        found.append(
            "no observation is held out: the errors of observations left out in turn are judged "
            "(fitted.leave_one_out)"
        )
    if plan.accept.translation is None and plan.accept.rotation is None:
        found.append("the plan accepts any error (accept: {translation: ..., rotation: ...})")
    return found
