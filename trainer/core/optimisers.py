"""torch's optimisers without torch's compiler.

Made or stepped, an optimiser of torch imports ``torch._dynamo``, to tell the compiler what not to compile:
1.3 s of the processor and 70 MB in each process that trains. Nothing is compiled here. These are the same
classes, to the bit, with those methods as they are inside; if a version of torch wraps them in another way,
it is imported.
"""

from __future__ import annotations

import inspect

import torch


def _without_compiler(kind: type[torch.optim.Optimizer]) -> type:
    inner = {
        name: inspect.unwrap(getattr(kind, name))
        for name in ("add_param_group", "load_state_dict", "state_dict", "zero_grad")
    }
    return type(kind.__name__, (kind,), inner | {"step": torch.no_grad()(inspect.unwrap(kind.step))})


Adam = _without_compiler(torch.optim.Adam)
AdamW = _without_compiler(torch.optim.AdamW)
SGD = _without_compiler(torch.optim.SGD)
