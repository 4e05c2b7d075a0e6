"""Our pose network is the published one: same weights, same heatmaps as a slow NumPy forward pass.

On two real frames it finds what its authors printed.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from dhp19_example import LABELS, PREDICTED

from ctlev_core.networks.dhp19 import LAYERS, DHP19Network, load_published

REAL_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "real"
PUBLISHED_WEIGHTS = REAL_DATA / "dhp19_cnn" / "DHP_CNN.h5"
PUBLISHED_FRAMES = REAL_DATA / "dhp19_frames"


def read_kernels() -> dict[str, np.ndarray]:
    """Keras kernels by layer name: [3, 3, in, out], and [3, 3, out, in] for the transposed convolutions."""
    h5py = pytest.importorskip("h5py", reason="needs the test extra")
    if not PUBLISHED_WEIGHTS.is_file():
        pytest.skip("the published DHP19 weights are not part of the repository")
    with h5py.File(PUBLISHED_WEIGHTS) as file:
        weights = file["model_weights"]
        return {name: weights[name][name]["kernel:0"][:].astype(np.float64) for name in weights if len(weights[name])}


def convolve_same(image: np.ndarray, kernel: np.ndarray, dilation: int) -> np.ndarray:
    """[H, W, in] -> [H, W, out], zeros outside."""
    height, width, _ = image.shape
    padded = np.pad(image, ((dilation, dilation), (dilation, dilation), (0, 0)))
    total = np.zeros((height, width, kernel.shape[3]))
    for a in range(3):
        for b in range(3):
            total += padded[a * dilation : a * dilation + height, b * dilation : b * dilation + width] @ kernel[a, b]
    return total


def transposed_same(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """[H, W, in] -> [2H, 2W, out]: each pixel adds its kernel to the output, as Keras pads "same" with stride 2."""
    height, width, _ = image.shape
    total = np.zeros((2 * height + 1, 2 * width + 1, kernel.shape[2]))
    for y in range(height):
        for x in range(width):
            total[2 * y : 2 * y + 3, 2 * x : 2 * x + 3] += kernel @ image[y, x]
    return total[:-1, :-1]


def forward(image: np.ndarray, kernels: dict[str, np.ndarray]) -> np.ndarray:
    """The network layer by layer, [H, W] -> [H, W, 13]."""
    x = image[..., None]
    for name, _, dilation in (*LAYERS, ("pred_cube", 13, 1)):
        if name.startswith("pool"):
            x = x.reshape(x.shape[0] // 2, 2, x.shape[1] // 2, 2, -1).max(axis=(1, 3))
        elif name.endswith("up"):
            x = np.maximum(transposed_same(x, kernels[name]), 0)
        else:
            x = np.maximum(convolve_same(x, kernels[name], dilation), 0)
    return x


def test_published_weights_give_the_heatmaps_of_a_slow_forward_pass():
    kernels = read_kernels()
    network = DHP19Network()
    load_published(network, PUBLISHED_WEIGHTS)
    image = np.zeros((36, 28))
    image[6:30, 10:16] = np.random.default_rng(0).random((24, 6))
    expected = forward(image, kernels)
    with torch.inference_mode():
        heatmaps = network(torch.from_numpy(image)[None, None].float())[0].permute(1, 2, 0).numpy()
    scale = expected.max()
    assert scale > 0 and (expected.max(axis=(0, 1)) > 0).sum() >= 10, "the test image excites too few joints"
    # float32 with up to 576 products a sum, seventeen layers deep.
    np.testing.assert_allclose(heatmaps / scale, expected / scale, atol=1e-5)


def highest_pixels(image: np.ndarray) -> np.ndarray:
    """(row, column) [13, 2] of the highest pixel of each heatmap, which is how the authors print a prediction."""
    network = DHP19Network()
    load_published(network, PUBLISHED_WEIGHTS)
    with torch.inference_mode():
        heatmaps = network(torch.from_numpy(np.ascontiguousarray(image))[None, None].float() / 255)[0]
    return np.stack(np.unravel_index(heatmaps.flatten(1).argmax(dim=1).numpy(), image.shape), axis=1)


@pytest.mark.parametrize("camera", [2, 3])
def test_published_weights_find_the_printed_pixels_on_real_frames(camera):
    path = PUBLISHED_FRAMES / f"frame_cam{camera}.png"
    for needed in (PUBLISHED_WEIGHTS, path):
        if not needed.is_file():
            pytest.skip(f"{needed.name} of DHP19's authors is not part of the repository")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image.shape == (260, 344) and image.dtype == np.uint8

    def distance(found, printed):
        return np.linalg.norm(found - np.array(printed[camera]), axis=1).mean()

    found = highest_pixels(image)
    # 2.06 and 1.03 px. Not 0, for the frames are read back from figures, with dots and a legend over some pixels.
    assert distance(found, PREDICTED) < 3
    # The error by the labels is the printed one (6.90 and 5.80 px) within the same.
    assert distance(found, LABELS) == pytest.approx(distance(PREDICTED[camera], LABELS), abs=0.5)
    # Rows count from the top and columns from the left: a mirrored frame misses by 30 to 58 px.
    for mirrored in (image[::-1], image[:, ::-1]):
        assert distance(highest_pixels(mirrored), PREDICTED) > 20


def test_number_of_parameters_is_the_published_one():
    assert sum(parameter.numel() for parameter in DHP19Network().parameters()) == 218_592


@pytest.mark.parametrize("size", [(64, 64), (61, 47), (3, 5)])
@pytest.mark.parametrize("stride", [1, 2])
def test_heatmaps_cover_the_image(size, stride):
    network = DHP19Network(5, width=0.25, output_stride=stride)
    heatmaps = network(torch.zeros(2, 1, *size))
    assert heatmaps.shape == (2, 5, -(-size[0] // stride), -(-size[1] // stride))


def test_signal_keeps_its_size_through_the_network():
    """He initialisation: without it seventeen layers shrink the signal to nothing and training does not start."""
    torch.manual_seed(0)
    x = torch.rand(4, 1, 64, 64)
    heatmaps = DHP19Network()(x)
    assert 0.05 < heatmaps.std() / x.std() < 20
