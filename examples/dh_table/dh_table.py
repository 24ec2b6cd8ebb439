"""A realization: a table of Denavit-Hartenberg parameters, as many data sheets have it."""

import csv


class DhTable:
    """Files ``*.dh``: CSV with the columns joint, a (m), alpha (deg), d (m), mass (kg).

    Each row is one link in the classic convention: the joint turns about z, then the frame moves
    by d along z and a along x, and turns by alpha about x. A row without a joint is fixed. The
    frame after the last row is the site ``flange``. Data sheets state no inertia: a link's mass is
    a point at its end.
    """

    def mjcf(self, path):
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        bodies = place = ""
        for number, row in enumerate(rows, 1):
            name = row["joint"] or f"fixed_{number}"
            bodies += f'<body name="{name}_link"{place}>'
            if row["joint"]:
                bodies += f'<joint name="{name}" axis="0 0 1"/>'
            end = f"{row['a']} 0 {row['d']}"
            bodies += f'<inertial pos="{end}" mass="{row["mass"]}" diaginertia="1e-3 1e-3 1e-3"/>'
            place = f' pos="{end}" euler="{row["alpha"]} 0 0"'
        bodies += f'<site name="flange"{place}/>' + "</body>" * len(rows)
        return f'<mujoco model="{path.stem}"><worldbody>{bodies}</worldbody></mujoco>'
