"""Our TRPO against sb3-contrib's, on Hopper-v5 with termination, at equal steps and settings.

Run by hand in an environment that also has the extra "bench" (sb3-contrib) and imageio:
``python tests/load/trpo_against_sb3.py --steps 200000 --seeds 3``. Both get 16 lanes x 128 steps a
batch, 2 x 64 tanh networks, normalised observations and the same trust region; both are judged
by the stock return of the mean action over 16 episodes.
"""

import argparse
import json
import time

import gymnasium
import numpy as np
import torch

from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import Collector, evaluate
from onedemo.rl.trpo import Trpo, TrpoConfig
from onedemo.sim import vector_env

LANES, BATCH, EPISODES = 16, 128, 16
CONFIG = TrpoConfig(
    max_kl=0.01,
    gamma=0.99,
    lam=0.95,
    cg_iterations=15,
    damping=0.1,
    fisher_samples=LANES * BATCH,
    value_epochs=10,
    value_batch=128,
    value_rate=1e-3,
)


def ours(steps, seed):
    """Mean return and seconds of a training of ours."""
    started = time.monotonic()
    env = vector_env.make("hopper", LANES, nthread=0, terminate_when_unhealthy=True)
    policy = Policy(PolicyConfig(kind="raw"), obs_size=11, action_size=3, horizon=1000, seed=seed)
    trpo = Trpo(policy, CONFIG, seed=seed)
    collector = Collector(env, seed=seed, stagger=False)
    for _ in range(steps // (LANES * BATCH)):
        batch = collector.collect(policy.snapshot(), BATCH)
        trpo.update(batch)
    seconds = time.monotonic() - started
    episodes = evaluate(policy.snapshot(), "hopper", episodes=EPISODES, seed=1000 + seed)
    upright = env.robot.healthy(episodes.qpos, episodes.qvel)
    alive = np.logical_and.accumulate(upright[:, :-1], axis=1)  # the falling step still counts
    return (episodes.rewards * alive).sum(1).mean(), seconds


def theirs(steps, seed):
    """Mean return and seconds of a training of sb3-contrib's."""
    from sb3_contrib import TRPO
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    def lanes(count):
        return DummyVecEnv([lambda: Monitor(gymnasium.make("Hopper-v5"))] * count)

    started = time.monotonic()
    env = VecNormalize(lanes(LANES), norm_obs=True, norm_reward=True, gamma=CONFIG.gamma)
    model = TRPO(
        "MlpPolicy",
        env,
        n_steps=BATCH,
        batch_size=CONFIG.value_batch,
        gamma=CONFIG.gamma,
        gae_lambda=CONFIG.lam,
        cg_max_steps=CONFIG.cg_iterations,
        cg_damping=CONFIG.damping,
        target_kl=CONFIG.max_kl,
        n_critic_updates=CONFIG.value_epochs,
        learning_rate=CONFIG.value_rate,
        seed=seed,
        device="cpu",
    )
    model.learn(steps)
    seconds = time.monotonic() - started
    judge = VecNormalize(lanes(1), norm_obs=True, norm_reward=False, training=False)
    judge.obs_rms = env.obs_rms
    judge.seed(1000 + seed)
    mean, _ = evaluate_policy(model, judge, n_eval_episodes=EPISODES)
    return mean, seconds


def main():
    """Trains both for every seed and prints one JSON line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", choices=("ours", "sb3-contrib"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    for name, train in (("ours", ours), ("sb3-contrib", theirs)):
        if args.only not in (None, name):
            continue
        returns, speeds = [], []
        for seed in range(args.seeds):
            reward, seconds = train(args.steps, seed)
            returns.append(round(float(reward), 1))
            speeds.append(round(args.steps / seconds))
        result = {"returns": returns, "mean": round(float(np.mean(returns)), 1)}
        print(json.dumps({"trpo": name, **result, "steps_per_second": speeds}), flush=True)


if __name__ == "__main__":
    main()
