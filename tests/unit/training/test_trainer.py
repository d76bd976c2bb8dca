import ast
import os
import re
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import torch

import onedemo
from helpers.small_world import Thumbnail, drawn_demo, falling_demo, small_config
from onedemo.core.files import hold
from onedemo.demos.ground_truth import HiddenStates, hidden_path, load_hidden, save_hidden
from onedemo.errors import UserError
from onedemo.reward.episode_rules import PracticeRules
from onedemo.reward.learned_distance import MetricSnapshot
from onedemo.rl.rollouts import EpisodeRules, evaluate
from onedemo.sim import vector_env
from onedemo.storage.store import Store
from onedemo.training.learner import Learner
from onedemo.training.rating_queue import Simulated, due_in_round
from onedemo.training.runs import add_run, find_run
from onedemo.training.simulated_run import train
from onedemo.training.thread import Trainer
from onedemo.training.training_run import TrainingRun
from onedemo.vision.silhouette import learn as learn_robot


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return falling_demo(tmp_path_factory.mktemp("demo"))


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    yield store
    store.close()


def make_run(store, demo, simulated=None, config=None, name="r", encoder=None, **options):
    data_dir = store.path.parent
    config = config or small_config()
    found = find_run(store, data_dir, demo, name=name, wanted=config)
    run = found[0] if found else add_run(store, data_dir, demo, config, name=name)
    return TrainingRun(
        store=store, data_dir=data_dir, run=run, demo=demo, config=config, encoder=encoder or Thumbnail(),
        simulated=simulated, **options,
    )  # fmt: skip


def work(training, iterations=10**6):
    """Works on a run with a simulated rater until it is done, or stops asked after so many iterations."""
    training.prepare()
    while training.iteration < iterations and training.step() != "done":
        pass
    training.ask()


def make_trainer(store, demo, *, rest_s=(5.0, 300.0), **options):
    return Trainer(make_run(store, demo, **options), rest_s=rest_s)


def by_rule(segment, demo_step):
    """A rater without hidden states: a fixed rule of what the robot does."""
    return int(np.clip(round(1 + 4 * segment.obs[:, 0].mean() + demo_step % 2), 1, 5))


def wait_for(condition, seconds=180.0):
    """As long as it takes on a machine with much else to do; whoever waits in vain has found a fault."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def rate_all(store, run, rater, value=3):
    for state in ("cut", "ready"):
        for clip in store.clips.waiting(run, state):
            store.ratings.rate(clip.id, rater.id, value, latency_ms=5)


def headless(store, demo):
    """A whole run rated by the oracle; its summary."""
    return train(
        store=store,
        data_dir=store.path.parent,
        demo=demo,
        config=small_config(),
        encoder=Thumbnail(),
        progress=False,
    )


def test_a_headless_run_gives_its_summary(store, demo):
    summary = headless(store, demo)
    assert summary["ratings"] == sum(summary["ratings_by_class"]) == 18
    assert summary["env_steps"] == 2400
    for key in (
        "predicted_similarity", "true_similarity", "backflip_reward", "backflip_reward_raw_actions",
        "net_turns", "clean_turns",
    ):  # fmt: skip
        assert summary[key]["worst"] <= summary[key]["mean"] <= summary[key]["best"], key
    assert 1 <= summary["predicted_similarity"]["worst"] <= summary["predicted_similarity"]["best"] <= 5
    assert {"steps_per_s", "wall_s", "seed", "version"} <= summary.keys()
    iterations = store.runs.iterations(summary["run"])
    assert [row["number"] for row in iterations] == [1, 2, 3, 4, 5, 6]
    assert "true_reward" in iterations[0] and iterations[0]["kl"] <= 0.05


def test_every_reward_can_be_traced_to_ratings(store, demo):
    summary = headless(store, demo)
    run = summary["run"]
    snapshots = {row["number"]: row for row in store.runs.snapshots(run)}
    for iteration in store.runs.iterations(run):
        snapshot = snapshots[iteration["snapshot"]]
        ratings = store.ratings.for_training(run, as_of=snapshot["last_event"])
        assert len(ratings) == snapshot["ratings"] >= 12
        assert (store.path.parent / "runs" / run / "snapshots" / f"{iteration['snapshot']:06d}.pt").exists()
        assert set(iteration["seconds"]) == {"rollouts", "policy", "refit", "other"}
        assert iteration["disagreement"] >= 0 and "episode_seconds" in iteration
    # Each rating was forecast once, but those of before the first predictor.
    new = [snapshot.get("new", 0) for snapshot in snapshots.values()]
    assert new[0] == 0 and sum(new) == 18 - snapshots[1]["ratings"]
    assert all(s["hits"] <= s["new"] for s in snapshots.values() if "new" in s)
    stages = [row[6] for row in store.ratings.stream(run)]
    assert stages.count("pretrain") == 12 and stages.count("online") == 6


@pytest.mark.slow
def test_the_same_seed_gives_the_same_run(demo, tmp_path):
    curves = []
    for name, threads in (("one", 2), ("two", 1)):
        torch.set_num_threads(threads)  # what the process had before must not matter
        store = Store(tmp_path / name)
        work(make_run(store, demo, Simulated(name="rule", rate=by_rule)))
        rows = store.runs.iterations("r")
        curves.append([(row["predicted"], row["kl"], row["true_reward"]) for row in rows])
        store.close()
    assert curves[0] == curves[1] and len(curves[0]) == 6


def test_a_stopped_run_goes_on_where_it_was(store, demo):
    work(make_run(store, demo, Simulated(name="rule", rate=by_rule)), iterations=3)
    before = store.runs.iterations("r")
    assert len(before) == 3
    work(make_run(store, demo, Simulated(name="rule", rate=by_rule)))
    after = store.runs.iterations("r")
    assert after[: len(before)] == before
    assert [row["number"] for row in after] == [1, 2, 3, 4, 5, 6]
    assert after[-1]["env_steps"] == 2400 and sum(store.ratings.by_class("r")) == 18
    numbers = [row["number"] for row in store.runs.snapshots("r")]
    assert numbers == list(range(1, len(numbers) + 1))


@pytest.mark.slow
def test_people_rate_and_the_trainer_follows(store, demo):
    ann = store.accounts.ensure("Ann", "annotator")
    trainer_ = make_trainer(store, demo, config=small_config(rollouts__total_steps=10**6))
    trainer_.start()
    wait_for(lambda: trainer_.status().phase == "pretrain")
    assert trainer_.acting() is not None
    if sys.platform == "linux":  # people at the page come first
        (thread,) = [t for t in threading.enumerate() if t.name == "trainer"]
        assert os.getpriority(os.PRIO_PROCESS, thread.native_id) > os.getpriority(os.PRIO_PROCESS, 0)
    for _ in range(4):
        wait_for(lambda: store.clips.waiting("r", "cut"))
        assert len(store.clips.waiting("r", "cut")) <= 4  # the queue is not longer than asked
        rate_all(store, "r", ann)
        if trainer_.status().phase == "online":
            break
    wait_for(lambda: trainer_.status().iteration >= 2)
    fitted = store.runs.snapshots("r")[-1]["last_event"]
    wait_for(lambda: store.clips.waiting("r", "cut"))
    rate_all(store, "r", ann, value=5)
    wait_for(lambda: store.runs.snapshots("r")[-1]["last_event"] > fitted)
    trainer_.pause()
    wait_for(lambda: trainer_.status().phase == "paused")
    iterations = trainer_.status().iteration
    time.sleep(0.5)
    assert trainer_.status().iteration == iterations
    trainer_.resume()
    wait_for(lambda: trainer_.status().iteration > iterations)
    trainer_.stop()
    assert trainer_.status().phase == "stopped"
    iterations = trainer_.status().iteration
    trainer_.resume()  # from its checkpoint
    wait_for(lambda: trainer_.status().iteration > iterations)
    trainer_.stop()
    assert [row["number"] for row in store.runs.iterations("r")] == list(
        range(1, trainer_.status().iteration + 1)
    )
    marks = store.runs.marks("r")
    assert [kind for _, kind, _ in marks] == ["paused", "resumed", "stopped", "resumed", "stopped"]
    assert marks[-1][0] == trainer_.status().iteration


def test_after_a_failure_the_page_knows_and_rating_goes_on(store, demo, monkeypatch):
    ann = store.accounts.ensure("Ann", "annotator")
    trainer_ = make_trainer(
        store, demo, config=small_config(rollouts__total_steps=10**6, ratings__online=200)
    )

    iterate = Learner.iterate

    def break_down(self, snapshot):
        if self.iteration == 0:  # until there are clips of the policy nothing more is asked
            return iterate(self, snapshot)
        raise FloatingPointError("the policy has exploded")

    with monkeypatch.context() as broken:
        broken.setattr("onedemo.training.learner.Learner.iterate", break_down)
        trainer_.start()
        wait_for(lambda: rate_all(store, "r", ann) or trainer_.status().phase == "failed")
        assert trainer_.status().error == "FloatingPointError: the policy has exploded"
        given = trainer_.status().ratings
        wait_for(lambda: store.clips.waiting("r", "cut"))
        rate_all(store, "r", ann)
        assert trainer_.status().ratings > given
    trainer_.resume()
    wait_for(lambda: trainer_.status().iteration >= 2)
    assert trainer_.status().error == ""
    trainer_.stop()


def held_by_another(path):
    """Whether another process is refused a run's lock."""
    program = (
        f"from onedemo.core.files import hold\nwith hold(__import__('pathlib').Path({str(path)!r})): pass"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0 or "another onedemo is working on" in done.stderr, done.stderr
    return done.returncode != 0


def test_a_run_whose_stop_timed_out_is_held_until_its_thread_has_ended(store, demo, monkeypatch):
    """Amid an iteration: a second process is refused, then so is this one, then nobody."""
    begun, go_on, iterate = threading.Event(), threading.Event(), TrainingRun.iterate

    def long(self):
        begun.set()
        assert go_on.wait(60)
        iterate(self)

    monkeypatch.setattr(TrainingRun, "iterate", long)
    config = small_config(rollouts__total_steps=10**9, ratings__pretrain=1)
    training = make_run(store, demo, config=config)
    with ExitStack() as held:
        held.enter_context(hold(training.files.lock))
        trainer_ = Trainer(training, held.pop_all())
    ann = store.accounts.ensure("Ann", "annotator")
    trainer_.start()
    wait_for(lambda: rate_all(store, "r", ann) or begun.is_set())
    trainer_.stop(timeout_s=0.01)
    trainer_.release()
    assert trainer_.status().phase == "stopping" and trainer_.status().iteration == 0
    assert held_by_another(training.files.lock)
    with pytest.raises(UserError, match="another onedemo is working on"), hold(training.files.lock):
        pass
    assert trainer_.status().iteration == 0  # all of that within the iteration
    go_on.set()
    trainer_.stop()
    assert trainer_.status().phase == "stopped" and trainer_.status().iteration == 1
    assert not held_by_another(training.files.lock)


def test_after_a_stop_that_timed_out_one_thread_follows_the_other(store, demo, monkeypatch):
    """A run that is started again waits for the thread that has not ended; they never work side by side."""
    working, at_once, go = [], [], threading.Event()
    iterate = TrainingRun.iterate

    def slow(self):
        working.append(threading.current_thread())
        at_once.append(len(working))
        go.wait(20)
        iterate(self)
        working.pop()

    monkeypatch.setattr(TrainingRun, "iterate", slow)
    ann = store.accounts.ensure("Ann", "annotator")
    held = ExitStack()
    freed = []
    held.callback(lambda: freed.append(len(working)))
    training = make_run(store, demo, config=small_config(rollouts__total_steps=10**6))
    trainer_ = Trainer(training, held)
    trainer_.start()
    wait_for(lambda: rate_all(store, "r", ann) or working)
    trainer_.stop(timeout_s=0.01)
    trainer_.resume()
    trainer_.stop(timeout_s=0.01)
    trainer_.resume()
    go.set()
    wait_for(lambda: trainer_.status().iteration >= 3)
    trainer_.stop()
    assert set(at_once) == {1} and trainer_.status().phase == "stopped" and not freed
    trainer_.release()
    assert freed == [0]


@pytest.mark.slow
def test_people_rate_while_the_robot_is_looked_at_and_may_stop(store, demo):
    ann = store.accounts.ensure("Ann", "annotator")
    looked = threading.Event()

    def look(env, cache_dir, check):
        while not looked.wait(0.05):
            check()
        return learn_robot(env, cache_dir, check)

    config = small_config(method="onedemo", ratings__pretrain=30)
    trainer_ = make_trainer(store, demo, config=config, learn_robot=look)
    trainer_.start()
    for _ in range(3):
        wait_for(lambda: store.clips.waiting("r", "cut"))
        rate_all(store, "r", ann)
    assert trainer_.status().phase == "starting" and trainer_.status().ratings >= 9
    assert trainer_.acting() is None and not store.runs.snapshots("r")
    trainer_.stop(timeout_s=10)
    assert trainer_.status().phase == "stopped"
    trainer_.resume()
    wait_for(lambda: trainer_.status().phase == "starting")
    looked.set()
    wait_for(lambda: trainer_.status().phase == "pretrain" and trainer_.acting() is not None)
    trainer_.stop()


@pytest.mark.slow
def test_the_live_robot_follows_policy_and_snapshot(store, demo):
    ann = store.accounts.ensure("Ann", "annotator")
    config = small_config(
        method="onedemo", predictor__appearance=False, predictor__members=1,
        rollouts__total_steps=10**6, ratings__pretrain=12,
    )  # fmt: skip
    training = make_run(store, demo, config=config)
    trainer_ = Trainer(training)
    trainer_.start()
    wait_for(lambda: trainer_.acting() is not None)
    before = trainer_.acting()
    assert before is not None and type(before.rules) is EpisodeRules  # nothing says what is alike

    def rate_some():
        for clip in store.clips.waiting("r", "cut"):
            store.ratings.rate(
                clip.id, ann.id, by_rule(store.clips.segment(clip.id), clip.demo_step), latency_ms=5
            )
        return trainer_.status().iteration >= 2

    wait_for(rate_some)
    trainer_.stop()
    one, two = trainer_.acting(), trainer_.acting()
    assert one is not None and two is not None and one.rules is not two.rules
    assert isinstance(one.rules, PracticeRules)
    learner, snapshot = training.learner, training.snapshot
    np.testing.assert_array_equal(one.policy.weights[0], learner.policy().weights[0])
    env = vector_env.make("hopper", 1, horizon=101, nthread=0)
    obs, _ = env.reset(seed=5)
    expected = evaluate(
        learner.policy(), "hopper", episodes=1, seed=5, horizon=100,
        rules=learner.rules(1, snapshot),
    )  # fmt: skip
    clock = np.zeros(1, np.int32)
    for t in range(100):
        step, clock = one.step(env, obs, clock)
        obs = step.next_obs
        assert clock[0] == expected.clock[0, t + 1]
    env.close()
    assert not np.array_equal(expected.clock[0], np.arange(101))  # it waits, or hurries


@pytest.mark.slow
def test_clips_for_people_are_chosen_a_few_at_a_time(store, demo):
    ann = store.accounts.ensure("Ann", "annotator")
    trainer_ = make_trainer(store, demo, config=small_config(ratings__queue=12, ratings__pretrain=100))
    trainer_.start()
    wait_for(lambda: trainer_.status().phase == "pretrain" and len(store.clips.waiting("r", "cut")) == 12)
    for clip in store.clips.waiting("r", "cut")[:3]:
        store.ratings.rate(clip.id, ann.id, 3, latency_ms=5)
    time.sleep(0.5)  # it has looked twice
    assert len(store.clips.waiting("r", "cut")) == 9
    store.ratings.rate(store.clips.waiting("r", "cut")[0].id, ann.id, 3, latency_ms=5)
    wait_for(lambda: len(store.clips.waiting("r", "cut")) == 12)
    trainer_.stop()


def test_every_rating_asked_for_can_be_given(store, demo):
    """However few are left: a queue that is filled a few at a time must not keep the last ones back."""
    ann = store.accounts.ensure("Ann", "annotator")
    trainer_ = make_trainer(
        store, demo, config=small_config(ratings__queue=12, ratings__pretrain=30, ratings__online=0)
    )
    trainer_.start()

    def rate_one():
        for clip in store.clips.waiting("r", "cut")[:1]:
            store.ratings.rate(clip.id, ann.id, 3, latency_ms=5)
        return trainer_.status().ratings == 30

    wait_for(rate_one)
    assert not store.clips.waiting("r", "cut")
    trainer_.stop()


def test_a_run_of_before_there_were_methods_goes_on(store, demo):
    """Its config names no method, its snapshots hold one network, its checkpoint no rules."""
    config = small_config(practice__random_lanes=64, practice__bank_tries=8000)  # as they all were
    first = make_run(store, demo, Simulated(name="rule", rate=by_rule), config)
    work(first, iterations=3)
    before = store.runs.iterations("r")
    as_of_before(first.files.path)
    found = find_run(store, store.path.parent, demo, name="r", wanted=None)
    assert found is not None and found[1] == config
    second = make_run(store, demo, Simulated(name="rule", rate=by_rule), config)
    assert Trainer(second).status().method == "paper"
    work(second)
    after = store.runs.iterations("r")
    assert after[: len(before)] == before and [row["number"] for row in after] == [1, 2, 3, 4, 5, 6]


def as_of_before(directory):
    """Rewrites the files of a run as version 0.1 left them."""
    new = ("method", "starts", "pairing", "choice", "rounds", "kind", "appearance", "members", "ordinal")
    text = (directory / "config.toml").read_text()
    text = re.sub(r"\[practice\]\n(.+\n)+", "", text)
    lines = [line for line in text.splitlines() if line.split(" = ")[0] not in (*new, "final_kl")]
    kind = lines.index("[policy]") + 1
    (directory / "config.toml").write_text("\n".join([*lines[:kind], 'kind = "clock"', *lines[kind:]]) + "\n")
    for file in (directory / "snapshots").iterdir():
        data = torch.load(file, weights_only=True)
        (data["net"],) = data.pop("nets")
        data["config"] = {key: value for key, value in data["config"].items() if key not in new}
        torch.save(data, file)
    checkpoint = torch.load(directory / "checkpoint.pt", weights_only=True)
    del checkpoint["learner"]["rules"]
    if checkpoint["pool"] is not None:
        checkpoint["pool"]["env_rewards"] = checkpoint["pool"].pop("rewards")
    torch.save(checkpoint, directory / "checkpoint.pt")


def test_a_run_leaves_no_temporary_file(store, demo):
    training = make_run(store, demo, Simulated(name="rule", rate=by_rule))
    work(training)
    files = [p.name for p in training.files.path.rglob("*") if p.is_file()]
    assert not [name for name in files if name.startswith(".")]


# Nothing that learns can reach the demo's hidden states.

LEARNING = (
    "training.training_run",
    "training.thread",
    "training.learner",
    "reward.model",
    "reward.two_branch_net",
    "reward.learned_distance",
    "vision.pose_estimator",
    "vision.silhouette",
    "vision.silhouette_pictures",
    "vision.masks",
    "sim.kinematics",
    "rl.random_states",
    "reward.episode_rules",
    "rl.policy",
    "rl.trpo",
    "rl.rollouts",
    "queries.selection",
    "vision.encoders",
    "demos.library",
    "training.clip_worker",
    "reward.dataset",
)


def imports_of(module):
    source = Path(onedemo.__file__).parent / f"{module.replace('.', '/')}.py"
    found = set()  # a module that has moved is an error here
    for node in ast.walk(ast.parse(source.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module] + [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        found |= {name.removeprefix("onedemo.") for name in names if name.startswith("onedemo.")}
    folder = Path(onedemo.__file__).parent
    return {name for name in found if (folder / f"{name.replace('.', '/')}.py").exists()}


@pytest.mark.parametrize("module", LEARNING)
def test_learning_code_does_not_import_hidden_states(module):
    reached, todo = set(), {module}
    while todo:
        name = todo.pop()
        reached.add(name)
        todo |= imports_of(name) - reached
    forbidden = ("annotators", "evaluation", "demos.ground_truth", "training.simulated_run")
    assert not [name for name in reached if name.startswith(forbidden)], reached


_opened: list[str] = []
_watching = False


def _note_opens(event, arguments):
    if _watching and event == "open" and isinstance(arguments[0], str | bytes | Path):
        _opened.append(str(arguments[0]))


sys.addaudithook(_note_opens)


class Mixed(Thumbnail):
    """As in a network each feature sees all of the picture: none is constant in all pictures of a robot."""

    name = "mixed"

    def encode(self, frames):
        mixture = np.random.default_rng(0).normal(size=(self.dims, self.dims)).astype(np.float32)
        return super().encode(frames) @ mixture


def watched_run(store, demo, config):
    """A whole run rated by a rule, during which no hidden file may be opened; its end."""
    global _watching
    _opened.clear()
    _watching = True
    try:
        rater = Simulated(name="rule", rate=by_rule)
        training = make_run(store, demo, rater, config=config, encoder=Mixed())
        work(training)
    finally:
        _watching = False
    assert any(path.endswith("config.toml") or "checkpoint" in path for path in _opened)
    assert not [path for path in _opened if path.endswith(".hidden.npz")]
    return training.learner, training.snapshot


def learns_the_same_from_noise(demo, tmp_path, config):
    """Runs whose demo has its true hidden states, and noise in their place; the first one's end."""
    file = hidden_path(demo.path)
    truth = load_hidden(file)
    rng = np.random.default_rng(0)
    fields = ("obs", "actions", "qpos", "qvel")
    noise = HiddenStates(**{f: rng.normal(size=getattr(truth, f).shape) for f in fields})
    ends, asked, arrays = [], [], []
    try:
        for name, hidden in (("truth", truth), ("noise", noise)):
            save_hidden(file, hidden)
            store = Store(tmp_path / name)
            learner, snapshot = watched_run(store, demo, config)
            ends.append((learner, snapshot))
            arrays.append([*learner.policy().weights, learner.policy().mean, *flat(snapshot.tensors())])
            asked.append([store.clips.get(i) for i in range(1, store.clips.count("r") + 1)])
            store.close()
    finally:
        save_hidden(file, truth)
    assert asked[0] == asked[1] and len(asked[0]) >= 18  # the same clips, chosen alike
    for one, two in zip(*arrays, strict=True):
        np.testing.assert_array_equal(one, two)
    return ends[0]


def flat(tree):
    """All tensors of a snapshot."""
    if isinstance(tree, torch.Tensor):
        return [tree.numpy()]
    if isinstance(tree, str):  # of which robot it is
        return []
    return [x for branch in (tree.values() if isinstance(tree, dict) else tree) for x in flat(branch)]


@pytest.mark.slow
def test_training_opens_no_hidden_file_and_learns_the_same_from_noise(demo, tmp_path):
    """With the hidden states replaced by noise, the same ratings give the same policy."""
    learns_the_same_from_noise(demo, tmp_path, small_config())


ONEDEMO = {"method": "onedemo", "ratings__rounds": 2, "practice__give_up": 0.3}


@pytest.mark.seam
def test_the_method_with_its_own_pictures_learns_the_same_from_noise(tmp_path):
    """Silhouettes, choice of clips, clock, bank: none of it comes from the demo's hidden states."""
    demo = drawn_demo(tmp_path / "demo")
    learner, snapshot = learns_the_same_from_noise(
        demo, tmp_path, small_config(**ONEDEMO, rollouts__total_steps=800)
    )
    assert isinstance(snapshot, MetricSnapshot)  # it did see poses in the demo
    assert learner.config.practice.elastic and learner.config.practice.bank_share


@pytest.mark.seam
def test_a_run_of_the_method_is_the_same_after_a_stop_and_on_two_threads(tmp_path):
    """What the robot looks like and the bank are made again, the running similarity is kept."""
    demo = drawn_demo(tmp_path / "demo")
    rater = Simulated(name="rule", rate=by_rule)
    curves = []
    for name, threads in (("whole", 1), ("stopped", 1), ("two", 2)):
        settings = {"ratings__online": 0, "rollouts__total_steps": 1600, "rollouts__threads": threads}
        config = small_config(**ONEDEMO, **settings)
        options = {"config": config, "encoder": Mixed()}
        store = Store(tmp_path / name)
        if name == "stopped":
            work(make_run(store, demo, rater, **options), iterations=2)
            assert len(store.runs.iterations("r")) == 2
        work(make_run(store, demo, rater, **options))
        rows = store.runs.iterations("r")
        curves.append([(row["predicted"], row["kl"], row["true_reward"]) for row in rows])
        store.close()
    assert len(curves[0]) == 4
    assert curves[0] == curves[1]
    assert curves[0] == curves[2]


def test_every_round_before_practice_asks_for_more_until_all_are_given():
    for total in range(1, 21):
        for rounds in range(1, 13):
            given = [due_in_round(k, rounds, total) for k in range(1, max(total, rounds) + 1)]
            assert given[-1] == total and max(given) == total
            steps = np.diff([0, *given])
            assert (steps[: given.index(total) + 1] >= 1).all(), (total, rounds)
    assert [due_in_round(k, 10, 200) for k in (1, 2, 10)] == [20, 40, 200]
