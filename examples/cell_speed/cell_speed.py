"""An audit layer: joints that are faster than the risk assessment of a cell allows."""

from pytest_twin.audit.finding import Finding

ALLOWED = 3.0  # rad/s, from the risk assessment


class CellSpeed:
    """Velocity limits of hinges against the limit of the cell."""

    def check(self, asset, known, geometry):
        for joint in asset.joints:
            if joint.kind == "hinge" and joint.velocity is not None and joint.velocity > ALLOWED:
                yield Finding(
                    code="cell_speed.too_fast",
                    severity="warning",
                    place=joint.place,
                    element=f"joint '{joint.name}'",
                    title="the velocity limit is above that of the cell",
                    value=joint.velocity,
                    unit="rad/s",
                    expected=f"at most {ALLOWED} rad/s",
                    why="a motion plan may exceed the speed of the risk assessment",
                    settle="lower the limit in this file, or repeat the risk assessment",
                )
