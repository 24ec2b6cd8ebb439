"""A URDF of the Franka FR3 from the manufacturer's Denavit-Hartenberg parameters."""

import math

# a [m], d [m], alpha [rad] in Craig's convention.
ROWS = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
)
FLANGE_M = 0.107


def urdf() -> str:
    lines = ['<robot name="fr3">', '<link name="fr3_link0"/>']
    for at, (a, d, alpha) in enumerate(ROWS, 1):
        y, z = -d * math.sin(alpha), d * math.cos(alpha)
        lines += [
            f'<link name="fr3_link{at}"/>',
            f'<joint name="fr3_joint{at}" type="revolute">',
            f'<origin xyz="{a!r} {y!r} {z!r}" rpy="{alpha!r} 0 0"/>',
            f'<parent link="fr3_link{at - 1}"/><child link="fr3_link{at}"/>',
            '<axis xyz="0 0 1"/>',
            '<limit lower="-3" upper="3" effort="87" velocity="2"/></joint>',
        ]
    lines += [
        '<link name="fr3_link8"/>',
        '<joint name="fr3_joint8" type="fixed">',
        f'<origin xyz="0 0 {FLANGE_M}"/>',
        '<parent link="fr3_link7"/><child link="fr3_link8"/></joint>',
        "</robot>",
    ]
    return "\n".join(lines)
