"""The measurements of the procedural body: joints, profiles of trunk, limbs and head, and the flesh on top of them.

All in metres in the body's rest frame: y up, the body faces +z, left = +x. Only the left side is written down.
Lengths and girths are those of an average adult of 1.74 m and 68 kg, drawn by eye: no scan and no other body model went
into them.
"""

from __future__ import annotations

from typing import NamedTuple

# Rest joints; the right side mirrors the left.
MIDDLE_JOINTS = {
    "pelvis": (0, -0.223, 0.025),
    "spine1": (0, -0.114, 0.0),
    "spine2": (0, 0.021, 0.0),
    "spine3": (0, 0.074, 0.022),
    "neck": (0, 0.288, -0.015),
    "head": (0, 0.353, 0.035),
}
LEFT_JOINTS = {
    "hip": (0.069, -0.314, 0.022),
    "knee": (0.104, -0.693, 0.016),
    "ankle": (0.090, -1.091, -0.027),
    "foot": (0.116, -1.143, 0.094),
    "collar": (0.080, 0.194, -0.008),
    "shoulder": (0.174, 0.226, -0.017),
    "elbow": (0.431, 0.213, -0.042),
    "wrist": (0.683, 0.221, -0.045),
    "hand": (0.767, 0.214, -0.058),
}

Point = tuple[float, float, float]


class Tube(NamedTuple):
    """A limb as a modeller draws it: outlines from two sides, with a rounded section between them.

    Attributes:
        owners: (upper end along the axis, bone), in order; which bone moves which part.
        axis: 0, 1 or 2, the axis it runs along.
        sections: (position, low and high end along the first other axis, low and high end along the second), in order.
        caps: lengths of the rounded ends before the first and after the last section.
        exponent: 2 = ellipse, more = boxier.
        blend: width over which it flows into what came before it.
    """

    owners: tuple[tuple[float, str], ...]
    axis: int
    sections: tuple[tuple[float, float, float, float, float], ...]
    caps: tuple[float, float]
    exponent: float
    blend: float


class Cone(NamedTuple):
    """A cone with spherical ends, squeezed along the axes.

    Attributes:
        owner: the bone that moves it.
        start: centre of the first sphere.
        end: centre of the second.
        radii: of the two.
        blend: width over which it flows into what came before it.
        stretch: factors on its thickness along x, y, z.
        carve: taken away instead of added.
    """

    owner: str
    start: Point
    end: Point
    radii: tuple[float, float]
    blend: float
    stretch: Point = (1.0, 1.0, 1.0)
    carve: bool = False


INFINITE = 9.0

# Position y; x of the right and left outline; z of the back and front outline.
TRUNK = Tube(
    owners=((-0.114, "pelvis"), (0.021, "spine1"), (0.074, "spine2"), (INFINITE, "spine3")),
    axis=1,
    sections=(
        (-0.345, -0.128, 0.128, -0.080, 0.084),
        (-0.300, -0.161, 0.161, -0.091, 0.099),
        (-0.250, -0.165, 0.165, -0.096, 0.109),
        (-0.190, -0.156, 0.156, -0.088, 0.114),
        (-0.120, -0.140, 0.140, -0.080, 0.112),
        (-0.060, -0.136, 0.136, -0.082, 0.108),
        (0.000, -0.141, 0.141, -0.092, 0.107),
        (0.060, -0.149, 0.149, -0.107, 0.109),
        (0.120, -0.155, 0.155, -0.119, 0.106),
        (0.170, -0.152, 0.152, -0.122, 0.092),
        (0.215, -0.136, 0.136, -0.116, 0.068),
        (0.250, -0.108, 0.108, -0.102, 0.044),
    ),
    caps=(0.050, 0.045),
    exponent=2.35,
    blend=0.0,
)
NECK = Tube(
    owners=((INFINITE, "neck"),),
    axis=1,
    sections=(
        (0.230, -0.062, 0.062, -0.098, 0.030),
        (0.275, -0.055, 0.055, -0.082, 0.034),
        (0.320, -0.051, 0.051, -0.070, 0.043),
        (0.370, -0.050, 0.050, -0.064, 0.050),
        (0.410, -0.050, 0.050, -0.060, 0.056),
    ),
    caps=(0.04, 0.03),
    exponent=2.0,
    blend=0.035,
)
HEAD = Tube(
    owners=((INFINITE, "head"),),
    axis=1,
    sections=(
        (0.360, -0.045, 0.045, 0.014, 0.094),
        (0.385, -0.056, 0.056, -0.020, 0.102),
        (0.410, -0.064, 0.064, -0.047, 0.107),
        (0.440, -0.070, 0.070, -0.068, 0.111),
        (0.470, -0.0745, 0.0745, -0.077, 0.115),
    ),
    caps=(0.022, 0.097),
    exponent=2.12,
    blend=0.022,
)
# Position y; x of the inner and outer outline; z of the back and front outline.
LEG = Tube(
    owners=((-1.075, "ankle"), (-0.693, "knee"), (INFINITE, "hip")),
    axis=1,
    sections=(
        (-1.120, 0.061, 0.119, -0.062, 0.010),
        (-1.060, 0.060, 0.120, -0.063, 0.012),
        (-1.000, 0.061, 0.126, -0.062, 0.020),
        (-0.930, 0.053, 0.142, -0.070, 0.032),
        (-0.860, 0.047, 0.154, -0.078, 0.043),
        (-0.800, 0.047, 0.156, -0.075, 0.050),
        (-0.745, 0.052, 0.154, -0.062, 0.056),
        (-0.690, 0.053, 0.155, -0.053, 0.065),
        (-0.630, 0.044, 0.160, -0.063, 0.077),
        (-0.550, 0.029, 0.168, -0.075, 0.086),
        (-0.470, 0.017, 0.173, -0.084, 0.092),
        (-0.400, 0.011, 0.172, -0.086, 0.094),
        (-0.340, 0.014, 0.167, -0.084, 0.090),
        (-0.280, 0.020, 0.149, -0.070, 0.078),
        (-0.220, 0.030, 0.115, -0.045, 0.060),
    ),
    caps=(0.03, 0.03),
    exponent=2.1,
    blend=0.060,
)
# Position z; x of the inner and outer outline; y of the sole and the back of the foot.
FOOT = Tube(
    owners=((0.082, "ankle"), (INFINITE, "foot")),
    axis=2,
    sections=(
        (-0.058, 0.059, 0.116, -1.171, -1.098),
        (-0.020, 0.060, 0.122, -1.172, -1.076),
        (0.025, 0.064, 0.138, -1.171, -1.084),
        (0.065, 0.068, 0.155, -1.172, -1.108),
        (0.100, 0.071, 0.166, -1.173, -1.128),
        (0.128, 0.076, 0.164, -1.173, -1.140),
    ),
    caps=(0.030, 0.022),
    exponent=2.5,
    blend=0.028,
)
# Position x; y of the lower and upper outline; z of the back and front outline.
ARM = Tube(
    owners=((0.160, "collar"), (0.431, "shoulder"), (0.683, "elbow"), (INFINITE, "wrist")),
    axis=0,
    sections=(
        (0.130, 0.150, 0.262, -0.082, 0.046),
        (0.175, 0.163, 0.270, -0.075, 0.045),
        (0.220, 0.166, 0.270, -0.069, 0.040),
        (0.270, 0.165, 0.262, -0.068, 0.034),
        (0.325, 0.166, 0.255, -0.072, 0.024),
        (0.380, 0.171, 0.249, -0.077, 0.009),
        (0.430, 0.175, 0.247, -0.083, 0.000),
        (0.480, 0.174, 0.251, -0.087, 0.003),
        (0.530, 0.178, 0.252, -0.087, 0.000),
        (0.590, 0.188, 0.247, -0.081, -0.010),
        (0.645, 0.199, 0.241, -0.074, -0.017),
        (0.685, 0.201, 0.237, -0.075, -0.018),
        (0.720, 0.199, 0.233, -0.081, -0.018),
        (0.755, 0.198, 0.228, -0.090, -0.017),
    ),
    caps=(0.05, 0.018),
    exponent=2.1,
    blend=0.045,
)

# In the order in which they flow into one another. The middle ones are mirror images of themselves.
MIDDLE_PARTS: tuple[Tube | Cone, ...] = (
    TRUNK,
    NECK,
    HEAD,
    Cone("head", (0, 0.354, 0.083), (0, 0.356, 0.084), (0.019, 0.019), 0.022, (1.35, 1, 1)),  # chin
    Cone("head", (0, 0.386, 0.094), (0, 0.388, 0.094), (0.0115, 0.0115), 0.012, (1.6, 0.9, 1)),  # lips
)
LEFT_PARTS: tuple[Tube | Cone, ...] = (
    Cone("head", (0.014, 0.466, 0.104), (0.044, 0.464, 0.086), (0.013, 0.012), 0.018),  # brow
    Cone("head", (0.040, 0.414, 0.074), (0.053, 0.427, 0.054), (0.021, 0.019), 0.030),  # cheek
    Cone("head", (0.0315, 0.445, 0.116), (0.0335, 0.445, 0.115), (0.0135, 0.0135), 0.012, (1.3, 1, 1), True),  # eye
    Cone("head", (0, 0.456, 0.109), (0, 0.418, 0.122), (0.008, 0.0115), 0.012),  # nose
    Cone("head", (0.006, 0.413, 0.112), (0.010, 0.413, 0.110), (0.009, 0.008), 0.008),  # nostril
    Cone("head", (0.074, 0.424, 0.012), (0.080, 0.452, 0.003), (0.011, 0.019), 0.010, (0.5, 1, 1)),  # ear
    Cone("collar", (0.020, 0.310, -0.040), (0.165, 0.244, -0.028), (0.026, 0.036), 0.060),  # trapezius
    Cone("spine3", (0.060, 0.105, 0.066), (0.118, 0.150, 0.040), (0.046, 0.044), 0.050),  # pectoral
    Cone("spine3", (0.085, -0.040, -0.040), (0.136, 0.150, -0.050), (0.030, 0.046), 0.060),  # latissimus
    Cone("spine3", (0.080, 0.020, -0.065), (0.095, 0.180, -0.076), (0.030, 0.042), 0.050),  # shoulder blade
    Cone("pelvis", (0.076, -0.205, -0.034), (0.077, -0.280, -0.050), (0.064, 0.077), 0.070),  # gluteus
    ARM,
    Cone("elbow", (0.428, 0.211, -0.070), (0.438, 0.211, -0.070), (0.020, 0.018), 0.024),  # tip of the elbow
    Cone("shoulder", (0.185, 0.238, -0.016), (0.260, 0.222, -0.018), (0.046, 0.036), 0.035),  # deltoid
    LEG,
    Cone("knee", (0.104, -0.684, 0.044), (0.104, -0.706, 0.042), (0.025, 0.022), 0.022),  # kneecap
    FOOT,
    Cone("ankle", (0.090, -1.080, -0.048), (0.089, -1.135, -0.058), (0.017, 0.027), 0.026),  # heel
    Cone("ankle", (0.069, -1.080, -0.018), (0.070, -1.090, -0.020), (0.015, 0.015), 0.020),  # inner ankle
    Cone("ankle", (0.111, -1.088, -0.028), (0.111, -1.100, -0.030), (0.015, 0.015), 0.020),  # outer ankle
    Cone("foot", (0.093, -1.157, 0.115), (0.094, -1.158, 0.160), (0.018, 0.0155), 0.010, (1.1, 0.9, 1)),  # big toe
    Cone("foot", (0.123, -1.160, 0.154), (0.157, -1.161, 0.128), (0.0125, 0.0115), 0.014),  # the other toes
    # The back of the hand, one cone a finger, then the fingers, slightly bent and spread.
    Cone("wrist", (0.690, 0.219, -0.040), (0.776, 0.215, -0.025), (0.009, 0.0132), 0.014),
    Cone("wrist", (0.690, 0.219, -0.044), (0.781, 0.216, -0.047), (0.009, 0.0132), 0.014),
    Cone("wrist", (0.690, 0.219, -0.048), (0.777, 0.215, -0.069), (0.009, 0.0128), 0.014),
    Cone("wrist", (0.690, 0.219, -0.052), (0.765, 0.212, -0.088), (0.009, 0.0122), 0.014),
    Cone("hand", (0.776, 0.213, -0.024), (0.820, 0.206, -0.016), (0.0105, 0.0095), 0.018),
    Cone("hand", (0.820, 0.206, -0.016), (0.855, 0.190, -0.009), (0.0095, 0.0085), 0.006),
    Cone("hand", (0.781, 0.214, -0.047), (0.830, 0.206, -0.047), (0.0105, 0.0096), 0.018),
    Cone("hand", (0.830, 0.206, -0.047), (0.868, 0.188, -0.047), (0.0096, 0.0087), 0.006),
    Cone("hand", (0.777, 0.213, -0.069), (0.823, 0.204, -0.079), (0.0102, 0.0093), 0.018),
    Cone("hand", (0.823, 0.204, -0.079), (0.857, 0.187, -0.085), (0.0093, 0.0085), 0.006),
    Cone("hand", (0.765, 0.209, -0.089), (0.802, 0.201, -0.107), (0.0095, 0.0088), 0.018),
    Cone("hand", (0.802, 0.201, -0.107), (0.831, 0.187, -0.119), (0.0088, 0.0082), 0.006),
    Cone("wrist", (0.690, 0.214, -0.040), (0.740, 0.204, 0.001), (0.010, 0.0145), 0.018),  # ball of the thumb
    Cone("wrist", (0.740, 0.204, 0.001), (0.773, 0.196, 0.020), (0.0125, 0.0112), 0.006),
    Cone("wrist", (0.773, 0.196, 0.020), (0.803, 0.189, 0.025), (0.0112, 0.0093), 0.006),
)

BLEND_OF_SIDES = 0.008
"""Between left and right the union is sharp, so that the thighs do not grow together."""


class FineRegion(NamedTuple):
    """Where the mesh is finer: beyond `start` along an axis (to the negative side for direction -1)."""

    axis: int
    direction: int
    start: float
    transition: float
    magnification: float
    centre: Point


FINE_REGIONS = (
    FineRegion(0, 1, 0.600, 0.170, 3.4, (0.0, 0.210, -0.042)),  # hands
    FineRegion(1, 1, 0.335, 0.050, 1.95, (0.0, 0.0, 0.020)),  # head
    FineRegion(1, -1, 1.030, 0.050, 1.9, (0.107, 0.0, 0.030)),  # feet
)

# Half the standard deviation of the soft border between two bones, m: wide where there is flesh, narrow at bony joints.
BORDER_M = {
    "pelvis": 0.035, "spine1": 0.045, "spine2": 0.045, "spine3": 0.045, "neck": 0.028, "head": 0.022, "hip": 0.030,
    "knee": 0.024, "ankle": 0.018, "foot": 0.014, "collar": 0.035, "shoulder": 0.036, "elbow": 0.018, "wrist": 0.018,
    "hand": 0.010,
}  # fmt: skip
# The groin: the leg's side of this plane through the hip joint moves with the leg (normal, then offset), left side.
GROIN_NORMAL = (0.30, -1.0, 0.55)
GROIN_POINT = (0.080, -0.375, 0.0)
