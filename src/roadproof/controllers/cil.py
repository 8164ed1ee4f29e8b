"""CIL: the conditional imitation learning network of CARLA's agent.

Notation:
    | name | meaning | shape at width 1 |
    |---|---|---|
    | frames | RGB in [0, 1] | b 3 88 200 |
    | image | image feature: 8 convolutions, 2 dense layers | b 512 |
    | speed | speed feature: 2 dense layers on speed_mps / 25 | b 128 |
    | joined | dense layer on (image, speed) | b 512 |
    | controls | steer, gas, brake of the branch that the command picks | b 3 |

References:
    Codevilla et al., "End-to-end driving via conditional imitation learning", ICRA 2018; layer sizes, batch
    normalisation, dropout and branch order are those of the published agent (carla-simulator/imitation-learning).
"""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from roadproof.controllers.conditional import BRANCHES, ConditionalNetwork
from roadproof.controllers.frames import require_frame_size
from roadproof.controllers.weights import initialise_xavier, seeded
from roadproof.errors import ControllerError
from roadproof.limits import LEAST_WIDTH, MOST_WIDTH

_KERNEL_STRIDE_CHANNELS = (
    (5, 2, 32), (3, 1, 32), (3, 2, 64), (3, 1, 64), (3, 2, 128), (3, 1, 128), (3, 1, 256), (3, 1, 256),
)  # fmt: skip
_LAST_MAP = (2, 16)


class CentredBatchNorm2d(nn.Module):
    """Batch normalisation with a learnt centre and no learnt scale, as TensorFlow's contrib layer has it by default."""

    bias: nn.Parameter
    running_mean: Tensor
    running_var: Tensor
    eps = 1e-3
    momentum = 0.1

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Normalise by the batch while training, by the running statistics otherwise."""
        return functional.batch_norm(
            x, self.running_mean, self.running_var, None, self.bias, self.training, self.momentum, self.eps
        )


class CIL(ConditionalNetwork):
    """The CIL network and the agent around it; a `Controller`.

    Args:
        width: factor on the number of channels and units of every hidden layer; 1 is the published network.
        seed: seed of the initial weights (Xavier, biases 0.1), drawn without touching the global random state.

    Raises:
        ControllerError: the width leaves a layer without units.

    Convention:
        The last feature map is flattened in H, W, C order, as TensorFlow does, so that published weights can be
        carried over. Branches, in order: follow, straight, left, right.
    """

    input_size = (88, 200)

    def __init__(self, *, width: float = 1.0, seed: int = 0) -> None:
        if not LEAST_WIDTH <= width <= MOST_WIDTH:
            raise ControllerError(f"CIL width is {width}, expected a factor between 1/32 and 8")
        super().__init__()
        self.width = width
        with seeded(seed):
            self._build(lambda units: max(1, round(units * width)))
            initialise_xavier(self, bias=0.1)

    def _build(self, scaled: Callable[[int], int]) -> None:
        channels = [3, *(scaled(c) for _, _, c in _KERNEL_STRIDE_CHANNELS)]
        self.convolutions = nn.Sequential(
            *(
                nn.Sequential(
                    OrderedDict(conv=nn.Conv2d(c_in, c_out, k, s), norm=CentredBatchNorm2d(c_out), relu=nn.ReLU())
                )
                for (k, s, _), c_in, c_out in zip(_KERNEL_STRIDE_CHANNELS, channels, channels[1:], strict=False)
            )
        )
        flat, image, speed, branch = channels[-1] * _LAST_MAP[0] * _LAST_MAP[1], scaled(512), scaled(128), scaled(256)
        self.image = nn.Sequential(*_dense(flat, image, dropout=0.3), *_dense(image, image, dropout=0.3))
        self.speed = nn.Sequential(*_dense(1, speed, dropout=0.5), *_dense(speed, speed, dropout=0.5))
        self.join = nn.Sequential(*_dense(image + speed, image, dropout=0.5))

        def head(outputs: int) -> nn.Sequential:
            hidden = (*_dense(image, branch, dropout=0.5), *_dense(branch, branch, dropout=0.0))
            return nn.Sequential(*hidden, nn.Linear(branch, outputs))

        self.branches = nn.ModuleList(head(3) for _ in range(BRANCHES))
        self.speed_branch = head(1)

    @property
    def is_folded(self) -> bool:
        """Whether batch normalisation has been merged into the convolutions."""
        return not any(isinstance(module, CentredBatchNorm2d) for module in self.modules())

    def folded(self) -> CIL:
        """A copy for inference with batch normalisation merged into the convolutions: same answers, fewer operations.

        The merged weights are W / √(var + ε) and the bias (b − mean) / √(var + ε) + centre. The copy is in eval mode,
        and its weights need no gradient.
        """
        copied = copy.deepcopy(self).eval().requires_grad_(False)
        for block in copied.convolutions:
            norm = block.get_submodule("norm")
            if isinstance(norm, CentredBatchNorm2d):
                conv = block.get_submodule("conv")
                assert isinstance(conv, nn.Conv2d)
                assert conv.bias is not None
                scale = (norm.running_var + norm.eps).rsqrt()
                conv.weight.data = conv.weight * scale[:, None, None, None]
                conv.bias.data = (conv.bias - norm.running_mean) * scale + norm.bias
                block.add_module("norm", nn.Identity())
        return copied

    def image_feature(self, frames: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b image"]:
        """The image feature, from convolutions and dense layers.

        Raises:
            ControllerError: the frames are not 88×200.
        """
        require_frame_size(frames, self.input_size)
        maps = self.convolutions(frames.to(next(self.parameters()).dtype))
        return self.image(maps.permute(0, 2, 3, 1).flatten(1))

    def joined(self, image: Float[Tensor, "b image"], speed: Float[Tensor, "b 1"]) -> Float[Tensor, "b joined"]:
        """The dense layer over image and speed features."""
        return self.join(torch.cat([image, self.speed(speed)], dim=1))


def _dense(inputs: int, outputs: int, *, dropout: float) -> tuple[nn.Module, ...]:
    return nn.Linear(inputs, outputs), nn.Dropout(dropout), nn.ReLU()
