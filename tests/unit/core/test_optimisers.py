import subprocess
import sys

SAME_WITHOUT = """
import sys, torch
from onedemo.core import optimisers

def steps(kind, **settings):
    torch.manual_seed(0)
    net, x = torch.nn.Linear(5, 3), torch.randn(20, 5)
    optimiser = kind(net.parameters(), 1e-2, **settings)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-2, total_steps=10)
    for _ in range(10):
        optimiser.zero_grad()
        net(x).pow(2).sum().backward()
        optimiser.step()
        schedule.step()
    optimiser.load_state_dict(optimiser.state_dict())
    return [*net.parameters()]

def of(kinds):
    return [steps(kinds.Adam, fused=True), steps(kinds.AdamW, foreach=True), steps(kinds.SGD, momentum=0.9)]

ours = of(optimisers)
assert "torch._dynamo" not in sys.modules
torchs = of(torch.optim)
assert all(torch.equal(a, b) for one, other in zip(ours, torchs) for a, b in zip(one, other))
"""


def test_optimisers_are_torch_s_to_the_bit_and_do_not_load_its_compiler():
    done = subprocess.run([sys.executable, "-c", SAME_WITHOUT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-1500:]
