from pathlib import Path

import pytest

from trainer.config import RunConfig, load_config, parse_override, to_toml
from trainer.errors import UserError


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
