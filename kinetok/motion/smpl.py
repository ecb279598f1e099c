"""The skeleton of SMPL, in the lengths of an average body: what AMASS files are read as, and written as."""

import numpy as np

# SMPL's body joints: name, parent, and the joint in its parent's frame in the T-pose: y up, facing z, left is x.
# The metres are our own round numbers for an adult of 1.7 m, not those of the SMPL model.
SKELETON = (
    ("pelvis", "", (0, 0, 0)),
    ("left_hip", "pelvis", (0.085, -0.08, 0)), ("right_hip", "pelvis", (-0.085, -0.08, 0)),
    ("spine1", "pelvis", (0, 0.11, -0.01)),
    ("left_knee", "left_hip", (0.01, -0.41, 0)), ("right_knee", "right_hip", (-0.01, -0.41, 0)),
    ("spine2", "spine1", (0, 0.13, 0)),
    ("left_ankle", "left_knee", (0, -0.41, -0.02)), ("right_ankle", "right_knee", (0, -0.41, -0.02)),
    ("spine3", "spine2", (0, 0.06, 0.01)),
    ("left_foot", "left_ankle", (0.02, -0.06, 0.13)), ("right_foot", "right_ankle", (-0.02, -0.06, 0.13)),
    ("neck", "spine3", (0, 0.21, -0.02)),
    ("left_collar", "spine3", (0.07, 0.11, -0.01)), ("right_collar", "spine3", (-0.07, 0.11, -0.01)),
    ("head", "neck", (0, 0.09, 0.03)),
    ("left_shoulder", "left_collar", (0.1, 0.03, -0.01)), ("right_shoulder", "right_collar", (-0.1, 0.03, -0.01)),
    ("left_elbow", "left_shoulder", (0.28, 0, 0)), ("right_elbow", "right_shoulder", (-0.28, 0, 0)),
    ("left_wrist", "left_elbow", (0.25, 0, 0)), ("right_wrist", "right_elbow", (-0.25, 0, 0)),
)  # fmt: skip
JOINTS = tuple(name for name, _, _ in SKELETON)
PARENTS = tuple(JOINTS.index(parent) if parent else -1 for _, parent, _ in SKELETON)
OFFSETS = np.array([offset for _, _, offset in SKELETON], dtype=np.float64)
