"""Pictures for real: every test that draws opens a GL context of its own."""

import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import CancelledError
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.paths import ROOT
from onedemo.demos.frame_clock import frame_of_step, steps_of_frames
from onedemo.render import renderer as renderer_module
from onedemo.render.backdrop import CHECK_DARK, CHECK_LIGHT, LANE, SKY_HORIZON, SKY_TOP, Viewpoint, backdrop
from onedemo.render.render_thread import RenderThread
from onedemo.render.renderer import HEIGHT, WIDTH, Renderer

STANDING = np.array([0, 1.25, 0, 0, 0, 0.0])

REPO = ROOT


def posed(**changes):
    """A standing robot with some positions changed, (1, 6)."""
    names = ("x", "z", "angle", "thigh", "leg", "foot")
    qpos = STANDING.copy()
    for name, value in changes.items():
        qpos[names.index(name)] = value
    return qpos[None]


def where_red(image):
    """Pixels of the torso, the only red limb, as (rows, columns)."""
    r, g, b = (image[..., i].astype(int) for i in range(3))
    return np.nonzero((r > 150) & (g < 110) & (b < 90))


# --- which frame shows which step -----------------------------------------------------------------


def test_frame_of_step_floors_and_stays_inside():
    # 0.008 s x 30 fps = 0.24 frames per step: 4 steps are 0.96, 5 are 1.2, 125 are 30 exactly.
    steps = np.array([0, 4, 5, 125, 999, 5000])
    assert frame_of_step(steps, 0.008, 30, 240).tolist() == [0, 0, 1, 30, 239, 239]
    assert frame_of_step(38, 0.008, 30, 240) == 9


def test_steps_that_fall_exactly_on_a_frame_do_not_miss_it():
    for k in range(10):  # 25 fps: 5 steps of 0.008 s a frame
        assert frame_of_step(5 * k, 0.008, 25, 100) == k
    assert frame_of_step(125 * np.arange(9), 0.008, 30, 300).tolist() == list(range(0, 270, 30))


def test_steps_of_frames_are_the_nearest_in_time():
    # Frame 1 is at 1/30 s = 4.17 steps, frame 2 at 8.33, frame 3 at 12.5 (up).
    assert steps_of_frames(5, 0.008, 30).tolist() == [0, 4, 8, 13, 17]
    steps = steps_of_frames(240, 0.008, 30)
    assert steps[-1] == 996
    assert np.abs(steps * 0.008 - np.arange(240) / 30).max() <= 0.004 + 1e-9


# --- the backdrop ---------------------------------------------------------------------------------

CAMERA = Viewpoint(x=0.0, z=1.0, distance=3.0, fovy=45.0)


def test_backdrop_is_sky_above_and_floor_below():
    image = backdrop(480, 360, CAMERA)
    assert image.shape == (360, 480, 3) and image.dtype == np.uint8
    assert np.abs(image[0, 0] - SKY_TOP).max() <= 1
    assert np.abs(image[182] - SKY_HORIZON).max() <= 2  # the far floor fades into the sky
    assert (image[-1].min(0) <= CHECK_DARK + 20).all()


def test_floor_moves_with_the_camera_by_one_period_every_two_metres():
    from dataclasses import replace

    here, half, whole = (backdrop(480, 360, replace(CAMERA, x=x)) for x in (0.3, 1.3, 2.3))
    assert np.abs(here.astype(int) - whole).max() <= 1
    assert np.abs(here.astype(int) - half).max() > 10


def test_far_floor_does_not_shimmer():
    # The last rows before the horizon hold many checks a pixel: their exact mean is one colour.
    image = backdrop(480, 360, CAMERA).astype(int)
    assert np.ptp(image[181:184], axis=1).max() <= 2


def test_shadow_is_darkest_under_a_low_limb_and_softer_under_a_high_one():
    def darkest(height):
        limb = np.array([[-0.2, 0.2, height, 0.05, 0.0]])
        plain = backdrop(480, 360, CAMERA).astype(int)
        return (plain - backdrop(480, 360, CAMERA, limb)).max()

    assert darkest(0.0) > darkest(0.5) > darkest(1.5) > 0
    assert darkest(-0.1) == darkest(0.0)  # a foot pressed into the floor


def test_backdrop_survives_a_limb_out_of_the_picture():
    limb = np.array([[900.0, 901.0, 0.0, 0.05, 0.0]])
    assert np.array_equal(backdrop(64, 48, CAMERA, limb), backdrop(64, 48, CAMERA))


# --- the robot ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def renderer():
    with Renderer() as made:
        yield made


@pytest.mark.seam
def test_pictures_show_the_robot_where_it_is(renderer):
    images = renderer.render(np.concatenate([posed(), posed(z=1.7), posed(angle=np.pi, z=1.6)]))
    assert images.shape == (3, HEIGHT, WIDTH, 3) and images.dtype == np.uint8
    standing, jumping, upside_down = (where_red(image) for image in images)
    assert abs(standing[1].mean() - WIDTH / 2) < 12  # the camera follows along the track
    assert jumping[0].mean() < standing[0].mean() - 40  # but a jump is seen as one
    blue = images[2][..., 2].astype(int) - images[2][..., 0] > 60
    assert upside_down[0].mean() > np.nonzero(blue)[0].mean()  # head below the legs


@pytest.mark.seam
def test_pictures_do_not_depend_on_what_was_drawn_before(renderer):
    poses = np.concatenate([posed(angle=a, x=a) for a in (0.0, -1.0, -4.0)])
    forth, back = renderer.render(poses), renderer.render(poses[::-1])[::-1]
    assert np.array_equal(forth, back)


@pytest.mark.seam
def test_robot_stays_in_the_picture_at_any_height_and_place(renderer):
    wanted = len(where_red(renderer.render(posed())[0])[0])
    for image in renderer.render(np.concatenate([posed(z=5.0), posed(x=500.0)])):
        assert len(where_red(image)[0]) > 0.8 * wanted


@pytest.mark.seam
def test_edges_are_smooth_and_no_black_shines_through(renderer):
    image = renderer.render(posed(angle=-0.4))[0].astype(int)
    assert image.sum(2).min() > 60
    rows, columns = where_red(image)
    row = int(np.median(rows))
    edge = image[row, columns.min() - 6 : columns.max() + 6, 1]
    assert len(np.unique(edge)) > 6


@pytest.mark.seam
def test_bad_positions_are_refused(renderer):
    with pytest.raises(ValueError, match=r"\(T, 6\)"):
        renderer.render(STANDING)
    with pytest.raises(ValueError, match="finite"):
        renderer.render(posed(z=np.nan))
    assert renderer.render(np.empty((0, 6))).shape == (0, HEIGHT, WIDTH, 3)
    with pytest.raises(ValueError, match="even"):
        Renderer(481, 360)


@pytest.mark.seam
def test_two_renderers_of_different_sizes_live_side_by_side(renderer):
    with Renderer(224, 224) as small:
        assert small.render(posed()).shape == (1, 224, 224, 3)
        assert renderer.render(posed()).shape == (1, HEIGHT, WIDTH, 3)
        before = renderer.render(posed())
        small.close()
        small.close()
        assert np.array_equal(renderer.render(posed()), before)  # it took only its own down
        with pytest.raises(RuntimeError, match="closed"):
            small.render(posed())


@pytest.mark.seam
def test_another_thread_is_told_to_use_the_render_thread(renderer):
    caught = []

    def draw():
        try:
            renderer.render(posed())
        except RuntimeError as error:
            caught.append(str(error))

    thread = threading.Thread(target=draw)
    thread.start()
    thread.join()
    assert "RenderThread" in caught[0]


@pytest.mark.seam
def test_what_is_read_of_a_picture_holds_all_of_the_robot(monkeypatch):
    """Also where it jumps, lies, or leaves the picture; and for people it looks the same."""
    rng = np.random.default_rng(3)
    poses = np.column_stack(
        [rng.uniform(-20, 20, 12), rng.uniform(0.1, 3.0, 12), *rng.uniform(-3, 3, (4, 12))]
    )
    with Renderer() as renderer, Renderer(exact=False) as quick:
        cut, people = renderer.render(poses).astype(int), quick.render(poses).astype(int)
        monkeypatch.setattr(
            renderer_module, "_part", lambda shape, eye, window, width, height: (0, 0, width, height)
        )
        assert np.array_equal(renderer.render(poses), cut)
    apart = np.abs(people - cut).max(-1)
    assert (apart > 0).mean() < 1e-3 and (apart > 2).mean() < 1e-5


def test_the_floor_is_what_the_formula_says_pixel_by_pixel():
    for x, z in ((-31.7, 0.88), (0.0, 0.88), (12.345, 1.31)):
        camera = replace(CAMERA, x=x, z=z)
        picture = backdrop(480, 360, camera)
        focal = 360 / 2 / np.tan(np.radians(camera.fovy) / 2)
        for row in (180, 190, 230, 300, 359):
            depth = camera.z / ((np.float32(row) + 0.5 - 180) / focal)
            edges = (np.arange(481, dtype=np.float32) - 240) / focal
            border = np.float32(camera.x) + depth * edges
            wave = np.diff(1 - np.abs(np.mod(border, 2) - 1)) / (depth / np.float32(focal))
            y, deep = depth - camera.distance, depth**2 / (camera.z * focal)
            across = np.diff([1 - np.abs(np.mod(end, 2) - 1) for end in (y - deep / 2, y + deep / 2)]) / deep
            covered = np.clip((min(y + deep / 2, 0.33) - max(y - deep / 2, -0.33)) / deep, 0, 1)
            lane, fog = (
                np.float32(covered) * np.float32(0.6),
                1 - np.exp(-max(depth - camera.distance, 0) / 4.5),
            )
            dark = CHECK_DARK + lane * (LANE - CHECK_DARK)
            dark = dark + fog * (SKY_HORIZON - dark)
            lift = (CHECK_LIGHT - CHECK_DARK) * (1 - lane) * (1 - fog)
            floor = (0.5 + 0.5 * wave[:, None] * across) * lift
            wanted = (np.float32(floor) + dark + 0.5).astype(np.uint8)
            assert np.abs(picture[row].astype(int) - wanted).max() <= 1
            assert (picture[row] != wanted).mean() < 0.01


# --- the render thread ----------------------------------------------------------------------------


@pytest.mark.seam
def test_render_thread_serves_many_threads(renderer):
    poses = np.concatenate([posed(angle=-a / 3) for a in range(6)])
    wanted = renderer.render(poses)
    got = [None] * 6
    with RenderThread() as drawing:

        def ask(i):
            got[i] = drawing.render(poses[i : i + 1]).result(30)[0]

        threads = [threading.Thread(target=ask, args=(i,)) for i in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert np.array_equal(np.stack(got), wanted)


@pytest.mark.seam
def test_errors_reach_the_future_and_the_thread_lives_on():
    with RenderThread(64, 48) as drawing:
        assert isinstance(drawing.submit(lambda _: 1 / 0).exception(30), ZeroDivisionError)
        assert isinstance(drawing.render(STANDING).exception(30), ValueError)
        assert drawing.submit(lambda r: (r.width, r.height)).result(30) == (64, 48)


@pytest.mark.seam
def test_close_ends_the_job_in_hand_and_cancels_the_rest():
    drawing = RenderThread(64, 48)
    begun, go_on = threading.Event(), threading.Event()

    def slow(_):
        begun.set()
        return go_on.wait(30)

    first, second = drawing.submit(slow), drawing.submit(lambda _: "never")
    begun.wait(30)
    closer = threading.Thread(target=drawing.close)
    closer.start()
    while not drawing._closed:
        pass
    go_on.set()
    closer.join(30)
    assert first.result(0) is True
    with pytest.raises(CancelledError):
        second.result(5)
    drawing.close()
    with pytest.raises(RuntimeError, match="closed"):
        drawing.submit(lambda _: 0)


# --- machines that cannot draw --------------------------------------------------------------------

_DRAW = """
from onedemo.core.process import prepare_process
prepare_process()
import onedemo.sim.vector_env, mujoco
from onedemo.errors import UserError
from onedemo.render.render_thread import RenderThread
from onedemo.render.renderer import Renderer
mujoco.MjModel.from_xml_string("<mujoco/>")
for make in (Renderer, RenderThread):
    try:
        make()
    except UserError as error:
        print(error)
"""


def draw_elsewhere(before=(), **environment):
    clean = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    done = subprocess.run(
        [*before, sys.executable, "-c", _DRAW],
        cwd=REPO,
        env={**clean, **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.seam
@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux draws without a screen")
def test_without_a_driver_one_sentence_names_the_packages():
    lines = draw_elsewhere(__EGL_VENDOR_LIBRARY_FILENAMES="/nonexistent")
    assert len(lines) == 2 and lines[0] == lines[1]
    assert "apt-get install libegl1" in lines[0] and "libgl1-mesa-dri" in lines[0]


@pytest.mark.seam
@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux draws without a screen")
def test_without_the_egl_library_physics_still_works_and_one_sentence_names_it(tmp_path):
    # Hides the real library from a child process: a private mount over the file, by root only.
    found = sorted({p.resolve() for p in Path("/usr/lib").glob("**/libEGL.so.1")})
    hide = "".join(f"mount --bind /dev/null {p} && " for p in found) + 'exec "$@"'
    before = ["unshare", "--mount", "sh", "-c", hide, "sh"]
    probe = shutil.which("unshare") and found
    if not probe or subprocess.run([*before, "true"], capture_output=True).returncode:
        pytest.skip("hiding libEGL needs the right to mount")
    lines = draw_elsewhere(before)
    assert len(lines) == 2
    assert "libEGL.so.1 is not installed" in lines[0] and "apt-get install libegl1" in lines[0]


@pytest.mark.seam
@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux draws without a screen")
@pytest.mark.parametrize("device", ["3", "abc"])
def test_a_wrong_egl_device_is_named(device):
    lines = draw_elsewhere(MUJOCO_EGL_DEVICE_ID=device)
    assert f"MUJOCO_EGL_DEVICE_ID={device} is not the number of a device" in lines[0]
    assert "unset it" in lines[0] and "apt-get" not in lines[0]


@pytest.mark.seam
@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux draws without a screen")
def test_software_draws_the_same_where_egl_does_not_work(tmp_path):
    from onedemo.core.process import gl_loads

    without = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}
    assert "apt-get install libosmesa6, and set MUJOCO_GL=osmesa" in draw_elsewhere(**without)[0]
    if not gl_loads("osmesa"):
        assert "apt-get install libosmesa6" in draw_elsewhere(**without, MUJOCO_GL="osmesa")[0]
        pytest.skip("there is no OSMesa: install the package libosmesa6")
    code = (
        "import sys, numpy as np\nfrom onedemo.core.process import prepare_process\nprepare_process()\n"
        "from onedemo.render.render_thread import RenderThread\n"
        "from onedemo.render.renderer import Renderer\n"
        "qpos = np.array([[0, 1.25, 0, 0, 0, 0.0]])\n"
        "with Renderer() as own, RenderThread() as other:\n"  # two contexts, of two threads
        "    pictures = [own.render(qpos), other.render(qpos).result(), own.render(qpos)]\n"
        "np.save(sys.argv[1], np.concatenate(pictures))"
    )
    drawn = []
    for name, environment in (
        ("egl", {"PYOPENGL_PLATFORM": "osmesa"}),  # of somebody's shell; it is not asked
        ("osmesa", without | {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "egl"}),
    ):
        command = [sys.executable, "-c", code, str(tmp_path / name)]
        clean = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
        done = subprocess.run(command, cwd=REPO, env=clean | environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        drawn.append(np.load(tmp_path / f"{name}.npy").astype(int))
    assert drawn[0].std() > 5 and np.abs(drawn[0] - drawn[1]).max() <= 2
    assert all((pictures == pictures[0]).all() for pictures in drawn)


def test_pictures_turned_off_by_the_user_say_so():
    lines = draw_elsewhere(MUJOCO_GL="disable")
    assert len(lines) == 2 and "MUJOCO_GL=disable turns pictures off" in lines[0]


@pytest.mark.seam
@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux draws without a screen")
@pytest.mark.parametrize("gl", [None, "glfw", "egl"])
def test_a_program_that_imports_onedemo_draws_whatever_it_has_set(gl):
    """It has not called ``prepare_process``: it is somebody else's."""
    code = (
        "import numpy as np\nfrom onedemo.render.renderer import Renderer\n"
        "print(Renderer(64, 48).render(np.array([[0, 1.25, 0, 0, 0, 0.0]])).std() > 5)"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=environment | ({"MUJOCO_GL": gl} if gl else {}),
        capture_output=True,
        text=True,
    )
    assert done.stdout == "True\n", done.stderr[-1500:]
