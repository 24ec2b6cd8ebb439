"""A kind of golden: how far a tool is from a singular pose."""

import numpy as np

from pytest_twin.checks import Check, Measure, Observation


class Manipulability(Check):
    """Smallest singular value of the tool's Jacobian of position, m/rad, at the zero pose."""

    kind = "manipulability"
    libraries = ("numpy",)
    tolerances = {"singular_value": "m"}
    required_tolerances = frozenset({"singular_value"})
    schema = {
        "target": {
            "type": "object",
            "properties": {"site": {"type": "string", "description": "the tool"}},
            "required": ["site"],
            "additionalProperties": False,
        }
    }

    def depends(self, golden, structure):
        return structure.chain([golden.target["site"]])

    def observe(self, golden, realization, progress):
        import mujoco  # here, not above: pytest collects without a simulator

        model, jacobian = realization.model, np.zeros((3, realization.model.nv))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(golden.target["site"]).id)
        values = np.linalg.svd(jacobian, compute_uv=False)
        return Observation({"smallest": float(values[min(model.nv, 3) - 1])})

    def compare(self, golden, observation, stored):
        if golden.expected is None:  # not recorded yet
            return []
        found, expected = observation.values["smallest"], golden.expected["smallest"]
        bound = golden.tolerance["singular_value"].value
        site = golden.target["site"]
        return [Measure("singular_value", site, found, expected, abs(found - expected), bound, "m")]
