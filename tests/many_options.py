"""Many options of a request at once, with which the weights that ship find grasps; a gripper."""

from typing import Any

OWN_GRIPPER: dict[str, Any] = {
    "max_opening": 0.07,
    "tip_z": 0.1,
    "contact_z": 0.09,
    "tcp_z": 0.08,
    "hand": {"boxes": [[[-0.1, -0.1, -0.1], [0.1, 0.1, 0.05]]]},
    "finger": {"boxes": [[[-0.01, 0.0, 0.05], [0.01, 0.01, 0.1]]]},
}

MANY: dict[str, Any] = {
    "gripper": "robotiq-2f-140",
    "seed": 11,
    "num_approach_points": 8,
    "num_candidates": 120,
    "sampling": "uniform",
    "viewpoint": [[0.3, 0.1, 0.6], [-0.4, 0.2, 0.5]],
    "up": [0.0, 0.0, 2.0],
    "support": {"kind": "ransac", "distance": 0.004, "max_tilt": 0.2},
    "workspace": {"min": [-0.3, -0.3, -0.05], "max": [0.3, 0.3, 0.4]},
    "approach_region": {
        "include": [
            {"kind": "sphere", "center": [0.0, 0.0, 0.08], "radius": 0.1},
            {"kind": "half_space", "normal": [0.0, 0.0, 1.0], "offset": 0.02},
        ],
        "exclude": [{"kind": "segments", "ids": [1]}],
    },
    "contact_region": {"exclude": [{"kind": "indices", "indices": [0, 5, 17]}]},
    "approach_direction": {
        "cones": [{"direction": [0.2, 0.0, -1.0], "max_angle": 0.9}],
        "preset": "top-down",
    },
    "collision": {
        "mode": "penalise",
        "margin": 0.001,
        "approach_length": 0.08,
        "retreat_length": 0.05,
        "retreat_direction": "up",
        "obstacles": [{"kind": "box", "min": [0.15, -0.2, 0.0], "max": [0.2, 0.2, 0.2]}],
    },
    "min_score": 1e-6,
    "top_k": 12,
    "suppression": {"translation": 0.005, "rotation": 0.2},
    "order": "clearance",
    "debug": True,
}
