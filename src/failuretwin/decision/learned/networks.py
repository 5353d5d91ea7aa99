"""The networks: the paper's LSTM, a plain CNN, and one that treats all motors alike.

Each takes standardised features (run, point, channel) and gives a score for each class
(run, class), the logarithm of its probability up to a constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from failuretwin.core.errors import unknown_name

HIDDEN = 100
"""Units of both LSTM layers, as published (Table I of the paper)."""
DROPOUT = 0.1
"""Share of units left out in training, as published."""
CNN_WIDTH = 96
MOTORWISE_WIDTH = 64
STRIDES = (1, 2, 2, 1)
"""Points by which each convolution moves on: 100 points become 50, then 25."""
KERNEL = 5
"""Points that a convolution sees, half a second of a run of ten."""


@dataclass(frozen=True)
class Shape:
    """What a network takes and gives.

    Attributes:
        channels: Channels of each point.
        classes: Number of classes.
        motors: Motors whose channels come first, equally many each; 1: all channels are alike.
        shared: Channels after those, which belong to no motor.
    """

    channels: int
    classes: int
    motors: int = 1
    shared: int = 0


class PaperLstm(nn.Module):
    """LSTM 100, dropout 0.1, LSTM 100, its last step, one dense layer: the paper's network."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.first = nn.LSTM(shape.channels, HIDDEN, batch_first=True)
        self.dropout = nn.Dropout(DROPOUT)
        self.second = nn.LSTM(HIDDEN, HIDDEN, batch_first=True)
        self.dense = nn.Linear(HIDDEN, shape.classes)
        for layer in (self.first, self.second):
            _begin_as_published(layer)
        nn.init.xavier_uniform_(self.dense.weight)
        nn.init.zeros_(self.dense.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return scores (run, class)."""
        steps, _ = self.first(x)
        steps, _ = self.second(self.dropout(steps))
        return self.dense(steps[:, -1])


def _begin_as_published(layer: nn.LSTM) -> None:
    """Draw weights as MATLAB's `lstmLayer` does, in which the paper's network was built.

    Its documented defaults: Glorot for what comes in, orthogonal for what comes back, biases of
    zero but one for the forget gate. PyTorch's own draw learns more slowly here.
    """
    weights = dict(layer.named_parameters())
    nn.init.xavier_uniform_(weights["weight_ih_l0"])
    nn.init.orthogonal_(weights["weight_hh_l0"])
    nn.init.zeros_(weights["bias_ih_l0"])
    nn.init.zeros_(weights["bias_hh_l0"])
    # Gates in the order input, forget, cell, output.
    nn.init.ones_(weights["bias_ih_l0"][HIDDEN : 2 * HIDDEN])


class Cnn(nn.Module):
    """Four convolutions over time, mean and largest value of each channel, one hidden layer."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        wide = CNN_WIDTH
        self.convolutions = nn.ModuleList(
            nn.Conv1d(taken, wide, KERNEL, stride=stride, padding=KERNEL // 2)
            for taken, stride in zip((shape.channels, wide, wide, wide), STRIDES, strict=True)
        )
        self.dropout = nn.Dropout(DROPOUT)
        self.hidden = nn.Linear(2 * wide, wide)
        self.dense = nn.Linear(wide, shape.classes)

    def forward(self, x: Tensor) -> Tensor:
        """Return scores (run, class)."""
        x = x.transpose(1, 2)
        for convolution in self.convolutions:
            x = torch.relu(convolution(x))
        seen = torch.cat([x.mean(dim=2), x.amax(dim=2)], dim=1)
        return self.dense(self.dropout(torch.relu(self.hidden(seen))))


class MotorWise(nn.Module):
    """The same convolutions look at every motor, each with an eye on the mean of all motors.

    What a stuck motor looks like is learned once, not for each motor anew; only the last layers,
    which name the class, tell the motors apart.
    """

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.motors, self.shared = shape.motors, shape.shared
        self.each = (shape.channels - shape.shared) // shape.motors
        wide = MOTORWISE_WIDTH
        sizes = list(zip((self.each + shape.shared, wide, wide, wide), STRIDES, strict=True))
        self.own = nn.ModuleList(
            nn.Conv1d(taken, wide, KERNEL, stride=stride, padding=KERNEL // 2)
            for taken, stride in sizes
        )
        self.all = nn.ModuleList(
            nn.Conv1d(taken, wide, KERNEL, stride=stride, padding=KERNEL // 2, bias=False)
            for taken, stride in sizes
        )
        self.dropout = nn.Dropout(DROPOUT)
        self.hidden = nn.Linear(2 * wide * shape.motors, 2 * wide)
        self.dense = nn.Linear(2 * wide, shape.classes)

    def forward(self, x: Tensor) -> Tensor:
        """Return scores (run, class)."""
        runs, points, _ = x.shape
        own = self.motors * self.each
        motor = x[:, :, :own].reshape(runs, points, self.motors, self.each)
        common = x[:, :, None, own:].expand(runs, points, self.motors, self.shared)
        x = torch.cat([motor, common], dim=3).permute(0, 2, 3, 1)  # run, motor, channel, point
        for own_part, all_part in zip(self.own, self.all, strict=True):
            each = own_part(x.flatten(0, 1)).unflatten(0, (-1, self.motors))
            x = torch.relu(each + all_part(x.mean(dim=1)).unsqueeze(1))
        seen = torch.cat([x.mean(dim=3), x.amax(dim=3)], dim=2).flatten(1)
        return self.dense(self.dropout(torch.relu(self.hidden(seen))))


NETWORKS: dict[str, type[PaperLstm] | type[Cnn] | type[MotorWise]] = {
    "lstm": PaperLstm,
    "cnn": Cnn,
    "motorwise": MotorWise,
}
"""The networks by name."""


def build_network(name: str, shape: Shape) -> nn.Module:
    """Return a new network with random weights (of torch's generator).

    Raises:
        InputError: If there is no such network.
    """
    if name not in NETWORKS:
        raise unknown_name("network", name, NETWORKS)
    return NETWORKS[name](shape)
