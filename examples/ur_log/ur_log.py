"""A recording reader: logs of Universal Robots' RTDE client, columns separated by spaces."""

import numpy as np

from pytest_twin.formats.recording import JointSeries, Recording

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


class UrLog:
    """Files ``*.rtde``: ``timestamp`` (s), ``actual_q_0`` to ``_5`` (rad), likewise others."""

    kind = "UR RTDE log"

    def reads(self, path):
        return path.is_file() and path.suffix == ".rtde"

    def read(self, path, options):
        table = np.genfromtxt(path, names=True)
        stamp = np.round(table["timestamp"] * 1e9).astype(np.int64)  # ns

        def series(topic, position, velocity):
            columns = [
                np.column_stack([table[f"{name}_{i}"] for i in range(len(JOINTS))])
                for name in (position, velocity)
            ]
            return JointSeries(topic, JOINTS, stamp, stamp, *columns, effort=None)

        state = series(options.topics["state"], "actual_q", "actual_qd")
        command = series(options.topics["command"], "target_q", "target_qd")
        return [Recording(path, {"state": state, "command": command}, metadata={}, damage=())]
