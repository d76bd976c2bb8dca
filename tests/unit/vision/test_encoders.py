"""Encoders on real weights where they ship, on files of the real layout where they do not."""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from onedemo.demos.library import import_video
from onedemo.demos.video import write_webm
from onedemo.errors import UserError
from onedemo.vision import encoders
from onedemo.vision.encoders import (
    EfficientNetLite0,
    Vgg16,
    check_weights,
    demo_features,
    make_encoder,
    published_lite0,
    vgg16_layers,
)
from onedemo.vision.folded import Folded


@pytest.fixture(scope="module")
def efficientnet():
    return make_encoder("efficientnet-lite0")


@pytest.fixture(scope="module")
def frames():
    """Six frames of a bright square crossing the picture."""
    images = np.full((6, 96, 160, 3), 60, np.uint8)
    for i, image in enumerate(images):
        image[30:66, 20 * i : 20 * i + 40] = (230, 80, 40)
    return images


@pytest.fixture
def demo(frames, tmp_path):
    write_webm(tmp_path / "move.webm", frames, fps=20)
    return import_video(tmp_path / "move.webm", name="move", demos_dir=tmp_path / "demos", fps=20)


# --- EfficientNet-Lite0 ---------------------------------------------------------------------------


def test_efficientnet_gives_one_vector_a_frame(efficientnet, frames):
    features = efficientnet.encode(frames)
    assert features.shape == (6, 1280) and features.dtype == np.float32
    assert np.isfinite(features).all() and features.min() >= 0  # after ReLU6
    assert features.std(0).mean() > 0.001  # it tells the frames apart


def test_features_do_not_depend_on_the_batch(efficientnet, frames):
    many = np.concatenate([frames] * 4)  # 24 frames, more than one batch
    features = efficientnet.encode(many)
    assert np.allclose(features[:6], features[18:], atol=1e-4)
    assert np.allclose(efficientnet.encode(frames[2:3])[0], features[2], atol=1e-4)
    assert efficientnet.encode(frames[:0]).shape == (0, 1280)


def test_features_are_what_the_network_classifies_by(efficientnet):
    # Input 127 must reach the network as 0, and the pooled map must be what its classifier takes.
    grey = np.full((1, 224, 224, 3), 127, np.uint8)
    features = torch.from_numpy(efficientnet.encode(grey))
    network = published_lite0()
    with torch.inference_mode():
        direct = network(torch.zeros(1, 3, 224, 224))
    assert torch.allclose(network._fc(features), direct, atol=1e-3)


def test_folding_changes_nothing():
    pixels = torch.randn((3, 3, 224, 224), generator=torch.Generator().manual_seed(0))
    network = published_lite0()
    with torch.inference_mode():
        wanted = network.extract_features(pixels)
        maps = Folded(network)(pixels)
    assert maps.shape == wanted.shape
    assert (maps - wanted).norm() < 1e-5 * wanted.norm()


def test_encoding_leaves_the_threads_of_torch_alone(efficientnet, frames):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        efficientnet.encode(frames)
        with ThreadPoolExecutor(1) as pool:
            assert torch.get_num_threads() == pool.submit(torch.get_num_threads).result() == 2
    finally:
        torch.set_num_threads(before)


def test_frames_may_come_one_by_one_and_a_failure_between_them_is_told(efficientnet, frames):
    wanted = efficientnet.encode(frames)
    assert np.array_equal(efficientnet.encode(frame for frame in frames), wanted)

    def broken():
        yield from frames[:5]
        raise UserError("the disk is gone")

    with pytest.raises(UserError, match="the disk is gone"):
        efficientnet.encode(broken())


def test_efficientnet_prints_nothing(capfd, frames):
    EfficientNetLite0().encode(frames[:1])
    assert capfd.readouterr() == ("", "")


def test_frames_of_another_kind_are_refused(efficientnet, frames):
    for bad in (frames[0], frames.astype(np.float32), frames[..., :2]):
        with pytest.raises(ValueError, match="uint8"):
            efficientnet.encode(bad)


# --- names ----------------------------------------------------------------------------------------


def test_unknown_encoders_are_refused_with_the_choices():
    with pytest.raises(UserError, match="'resnet'; choose efficientnet-lite0 or vgg16"):
        make_encoder("resnet")
    with pytest.raises(UserError, match="--encoder-weights goes with --encoder vgg16"):
        make_encoder("efficientnet-lite0", "weights.pth")


# --- VGG-16 ---------------------------------------------------------------------------------------

# The layout of torchvision's vgg16-397923af.pth, written down from the published file.
VGG16_KEYS = [
    f"{part}.{kind}"
    for part in [
        *(f"features.{i}" for i in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)),
        *(f"classifier.{i}" for i in (0, 3, 6)),
    ]
    for kind in ("weight", "bias")
]


def layout():
    with torch.device("meta"):
        return vgg16_layers().state_dict()


def test_vgg16_has_the_published_layout():
    wanted = layout()
    assert list(wanted) == VGG16_KEYS
    assert sum(tensor.numel() for tensor in wanted.values()) == 138_357_544
    assert tuple(wanted["classifier.0.weight"].shape) == (4096, 25088)


@pytest.fixture(scope="module")
def vgg16_file(tmp_path_factory):
    """A file of the real layout in a few bytes: each tensor repeats one small block."""
    generator = torch.Generator().manual_seed(0)
    weights = {}
    for key, tensor in layout().items():
        fan_in = tensor[0].numel() if tensor.ndim > 1 else 1
        scale = (2 / fan_in) ** 0.5 if tensor.ndim > 1 else 0.01
        # One row for all outputs, stored once: expand() keeps the file small.
        row = torch.randn(tensor.shape[1:], generator=generator) * scale
        weights[key] = row.expand(tensor.shape)
    path = tmp_path_factory.mktemp("weights") / "vgg16-test.pth"
    torch.save(weights, path)
    assert path.stat().st_size < 2_000_000
    return path


@pytest.mark.slow
def test_vgg16_loads_a_file_and_gives_its_last_4096_after_relu(vgg16_file, frames):
    encoder = make_encoder("vgg16", vgg16_file)
    assert encoder.name.startswith("vgg16-") and encoder.dims == 4096
    features = encoder.encode(frames[:2])
    assert features.shape == (2, 4096) and features.dtype == np.float32
    assert np.isfinite(features).all() and features.min() >= 0

    # The same by hand, layer by layer.
    import cv2

    weights = torch.load(vgg16_file, weights_only=True)
    network = vgg16_layers()
    network.load_state_dict(weights)
    network.eval()
    square = cv2.resize(frames[0], (224, 224), interpolation=cv2.INTER_AREA) / 255
    square = (square - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    pixels = torch.tensor(square, dtype=torch.float32).permute(2, 0, 1)[None]
    with torch.inference_mode():
        maps = network["features"](pixels)
        assert maps.shape == (1, 512, 7, 7)
        hidden = torch.relu(network["classifier"][0](maps.flatten(1)))
        wanted = torch.relu(network["classifier"][3](hidden))
    assert np.allclose(features[0], wanted[0].numpy(), atol=1e-3, rtol=1e-3)


def test_wrong_weights_name_the_first_wrong_key(tmp_path):
    wanted = layout()
    missing = {key: tensor for key, tensor in wanted.items() if key != "features.5.bias"}
    with pytest.raises(UserError, match=r"w.pth .*: features.5.bias is missing; give .*vgg16-39"):
        check_weights(missing, wanted, "w.pth")
    other = {**wanted, "classifier.6.weight": torch.empty(10, 4096, device="meta")}
    with pytest.raises(UserError, match=r"classifier.6.weight has shape \(10, 4096\), wanted \(1000"):
        check_weights(other, wanted, "w.pth")
    with pytest.raises(UserError, match=r"extra.weight is not part of it"):
        check_weights({**wanted, "extra.weight": torch.empty(1)}, wanted, "w.pth")
    with pytest.raises(UserError, match="but a list"):
        check_weights([1], wanted, "w.pth")
    torch.save({"conv.weight": torch.zeros(3)}, tmp_path / "small.pth")
    with pytest.raises(UserError, match=r"small.pth .*features.0.weight is missing"):
        Vgg16(tmp_path / "small.pth")


class Payload:
    """What a hostile file might hold: unpickling it would run code."""

    def __reduce__(self):
        return (print, ("weights ran code",))


def test_files_that_are_no_weights_are_refused(tmp_path, vgg16_file, capfd):
    (tmp_path / "text.pth").write_text("hello")
    (tmp_path / "empty.pth").write_bytes(b"")
    half = vgg16_file.read_bytes()
    (tmp_path / "half.pth").write_bytes(half[: len(half) // 2])
    torch.save({"features.0.weight": Payload()}, tmp_path / "hostile.pth")
    for name in ("text", "empty", "half", "hostile"):
        with pytest.raises(UserError, match="not a file of network weights"):
            Vgg16(tmp_path / f"{name}.pth")
    assert "ran code" not in capfd.readouterr().out
    with pytest.raises(UserError, match="no weights file at"):
        Vgg16(tmp_path / "none.pth")


def test_without_a_network_the_user_hears_where_to_get_the_file(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(encoders, "VGG16_URL", "http://127.0.0.1:9/vgg16-397923af.pth")
    with pytest.raises(UserError, match=r"could not be fetched .* --encoder-weights"):
        make_encoder("vgg16")
    assert not list(tmp_path.rglob("*.pth"))


def test_a_fetched_file_with_the_wrong_hash_is_refused(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    served = tmp_path / "vgg16-397923af.pth"
    served.write_bytes(b"not the published file")
    monkeypatch.setattr(encoders, "VGG16_URL", served.as_uri())
    with pytest.raises(UserError, match="is not the published file"):
        make_encoder("vgg16")


# --- the cache ------------------------------------------------------------------------------------


class Counting:
    """An encoder that counts its calls: the mean colour of each frame."""

    name = "mean-colour"
    dims = 3

    def __init__(self):
        self.calls = 0

    def encode(self, frames):
        self.calls += 1
        return np.array([frame.mean((0, 1), dtype=np.float32) for frame in frames])


def test_features_are_computed_once_and_kept(demo, tmp_path):
    encoder = Counting()
    first = demo_features(demo, encoder, tmp_path / "cache")
    second = demo_features(demo, encoder, tmp_path / "cache")
    assert first.shape == (6, 3) and np.array_equal(first, second) and encoder.calls == 1
    kept = [p.name for p in (tmp_path / "cache" / demo.sha256).iterdir()]
    assert kept == ["features-mean-colour.npz"]


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text", "shape", "pickle"])
def test_damaged_features_are_made_anew(demo, tmp_path, caplog, damage):
    encoder = Counting()
    wanted = demo_features(demo, encoder, tmp_path)
    path = tmp_path / demo.sha256 / "features-mean-colour.npz"
    whole = path.read_bytes()
    middle = whole.index(wanted.tobytes()[:8]) + 4
    if damage == "shape":
        np.savez(path, features=wanted[:3])
    elif damage == "pickle":
        np.savez(path, features=np.array([{}], dtype=object))
    else:
        path.write_bytes(
            {
                "cut": whole[: len(whole) // 2],
                "flip": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
                "empty": b"",
                "text": b"features",
            }[damage]
        )
    with caplog.at_level(logging.WARNING):
        assert np.array_equal(demo_features(demo, encoder, tmp_path), wanted)
    assert encoder.calls == 2 and ("is damaged" in caplog.text or "made anew" in caplog.text)
    assert path.read_bytes() == whole


def test_features_beside_the_demo_leave_the_library_as_it_was(demo, tmp_path):
    from onedemo.demos.library import list_demos

    demo_features(demo, Counting(), tmp_path / "demos")
    assert demo in list_demos(tmp_path / "demos")
