from pathlib import Path

import pytest

from onedemo.config import METHODS, RunConfig, load_config, parse_override, settings_for_another, to_toml
from onedemo.errors import UserError


def test_defaults_are_the_papers_numbers():
    config = load_config()
    assert (config.ratings.pretrain, config.ratings.online) == (200, 150)
    assert config.ratings.clip_seconds == 0.3
    assert config.predictor.sampling == "equal" and config.predictor.additional_layer


def test_toml_out_and_in_again(tmp_path):
    config = load_config(
        None, {"seed": 7, "trpo.max_kl": 0.02, "policy.hidden": [32, 16], "encoder": 'a"b\\c'}
    )
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert load_config(file) == config


def test_overrides_beat_the_file(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("seed = 1\n[trpo]\nmax_kl = 0.5\n")
    config = load_config(file, {"trpo.max_kl": 0.25})
    assert (config.seed, config.trpo.max_kl) == (1, 0.25)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sed = 1", "unknown key 'sed'; the nearest valid one is 'seed'"),
        ("[trpo]\nmax_kll = 1", "unknown key 'trpo.max_kll'; the nearest valid one is 'trpo.max_kl'"),
        ("[predictor]\nlearning_rat = 1", "'predictor.learning_rate'"),
        ("trpo = 3", "trpo is a section, not a value"),
        ("seed = 'x'", "seed must be a whole number, got 'x'"),
        ("device = 'gpu'", """device must be "cpu", "cuda" or "cuda:N", got 'gpu'"""),
        ("seed = true", "seed must be a whole number, got True"),
        ("[trpo]\nmax_kl = -1", "trpo.max_kl must be > 0 nats, got -1"),
        ("[ratings]\nonline = -1", "ratings.online must be at least 0, got -1"),
        ("[predictor]\nsampling = 'often'", "predictor.sampling must be"),
        ("[rollouts]\nphysics = 'gpu'", "rollouts.physics must be 'mujoco' or 'warp', got 'gpu'"),
        ("method = 'papers'", "method must be one of onedemo, paper, got 'papers'"),
        ("[ratings]\nstarts = 'flying'", "ratings.starts must be one of random, standing, got 'flying'"),
        ("[ratings]\npairing = 'x'", "ratings.pairing must be one of any, time, got 'x'"),
        (
            "[ratings]\nchoice = 'x'",
            "ratings.choice must be one of uniform, mix, high, disagreement, got 'x'",
        ),
        ("[ratings]\nrounds = 0", "ratings.rounds must be at least 1, got 0"),
        ("[predictor]\nkind = 'x'", "predictor.kind must be one of network, metric, got 'x'"),
        ("[predictor]\nmembers = 0", "predictor.members must be at least 1, got 0"),
        ("[practice]\nbank_share = 2", "practice.bank_share must be in 0..1, got 2"),
        ("[practice]\nelastic = 1", "practice.elastic must be true or false, got 1"),
        ("[policy]\nkind = 'x'", "policy.kind must be one of clock, table"),
        ("[trpo]\nfinal_kl = 0", "trpo.final_kl must be > 0 nats, got 0"),
        ("seed = ", "not valid TOML"),
    ],
)
def test_bad_files_get_one_clear_sentence(tmp_path, text, expected):
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(UserError) as caught:
        load_config(file)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file():
    with pytest.raises(UserError, match="cannot read the config file"):
        load_config(Path("/nowhere/config.toml"))


def test_overrides_are_toml_values_or_bare_words():
    assert parse_override("trpo.max_kl=0.02") == ("trpo.max_kl", 0.02)
    assert parse_override("predictor.sampling=random") == ("predictor.sampling", "random")
    assert parse_override("predictor.class_weights=true") == ("predictor.class_weights", True)
    with pytest.raises(UserError, match=r"section\.key=value"):
        parse_override("seed")


def test_whole_numbers_serve_as_numbers():
    assert load_config(None, {"trpo.max_kl": 1}).trpo.max_kl == 1.0
    assert isinstance(load_config(None, {"ratings.clip_seconds": 1}).ratings.clip_seconds, float)


def test_config_is_frozen():
    with pytest.raises(AttributeError):
        RunConfig().seed = 3  # type: ignore[misc]


# Methods


def value_at(config, dotted):
    for name in dotted.split("."):
        config = getattr(config, name)
    return config


@pytest.mark.parametrize("key", METHODS["paper"])
def test_the_paper_differs_from_onedemo_in_every_key_it_names(key):
    paper, onedemo = load_config(None, {"method": "paper"}), load_config()
    assert value_at(paper, key) == METHODS["paper"][key]
    assert value_at(onedemo, key) != METHODS["paper"][key]
    assert type(value_at(onedemo, key)) is type(METHODS["paper"][key])


def test_onedemo_is_the_default_and_sets_nothing():
    assert load_config() == load_config(None, {"method": "onedemo"}) == RunConfig()
    assert METHODS["onedemo"] == {}


def test_a_method_changes_nothing_that_it_does_not_name():
    paper = load_config(None, {"method": "paper"})
    changed = {key for key in flat(paper) if value_at(paper, key) != value_at(RunConfig(), key)}
    assert changed == {"method", *METHODS["paper"]}


def flat(config, prefix=""):
    """Dotted names of all settings."""
    names = []
    for name in config.__dataclass_fields__:
        value = getattr(config, name)
        nested = hasattr(value, "__dataclass_fields__")
        names += flat(value, f"{prefix}{name}.") if nested else [prefix + name]
    return names


@pytest.mark.parametrize("key", METHODS["paper"])
def test_each_switch_of_onedemo_can_be_set_in_the_paper(key):
    switched = load_config(None, {"method": "paper", key: value_at(RunConfig(), key)})
    paper = load_config(None, {"method": "paper"})
    assert {k for k in flat(paper) if value_at(switched, k) != value_at(paper, k)} == {key}


def test_the_method_of_a_file_yields_to_the_files_own_values(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("method = 'paper'\n[practice]\nelastic = true\n[predictor]\nmembers = 5\n")
    config = load_config(file)
    assert config.practice.elastic and config.predictor.members == 5
    assert config.practice.bank_share == 0 and config.predictor.kind == "network"
    assert load_config(file, {"practice.elastic": False}).practice.elastic is False
    back = load_config(file, {"method": "onedemo"})
    assert back.predictor.kind == "metric" and back.predictor.members == 5


@pytest.mark.parametrize("method", METHODS)
def test_a_run_with_a_method_is_recorded_whole(tmp_path, method):
    config = load_config(None, {"method": method, "trpo.final_kl": 0.02, "practice.give_up": 0.2})
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert load_config(file) == config


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_are_finite(value):
    with pytest.raises(UserError, match=r"practice\.slack_seconds must be a finite number"):
        load_config(None, {"practice.slack_seconds": value})


@pytest.mark.parametrize("method", METHODS)
def test_another_run_has_the_settings_of_the_one_at_hand(method):
    changed = {"ratings.pretrain": 7, "trpo.max_kl": 0.02, "seed": 3}
    told = load_config(None, {"method": "paper", "ratings.choice": "high"} | changed)
    config = load_config(None, settings_for_another(told, method))
    own = {"ratings.choice": "high"} if method == "paper" else {}
    assert config == load_config(None, {"method": method} | own | changed)


def test_a_setting_of_a_section_leaves_the_others_as_they_were():
    """The sections' own defaults are not always those of a run."""
    assert load_config(None, {"policy.log_std": -0.5}).policy.kind == load_config().policy.kind == "table"


def test_an_error_says_which_file_it_is_in(tmp_path):
    file = tmp_path / "c.toml"
    for text, said in (
        ("[trpo]\nmax_kll = 1", "unknown key 'trpo.max_kll'; the nearest valid one is 'trpo.max_kl'"),
        ("[trpo]\nmax_kl = 'x'", "trpo.max_kl must be a number, got 'x'"),
        ("[trpo]\nmax_kl = -1", "trpo.max_kl must be > 0 nats, got -1.0"),
    ):
        file.write_text(text)
        with pytest.raises(UserError) as caught:
            load_config(file)
        assert str(caught.value) == f"{file}: {said}"
    with pytest.raises(UserError, match=r"^trpo\.max_kl must be"):  # what was typed is not the file's fault
        load_config(file, {"trpo.max_kl": -2})


def test_an_empty_section_changes_nothing(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("[policy]\n")
    assert load_config(file) == load_config()
