"""The detector's network: a small U-shaped stack of convolutions from five planes to cells of 10 mm.

It is convolutional throughout, because a reflector looks alike wherever it stands; what differs with the
place (aspect, far side) reaches it through the receptive field, which spans the object.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from train.planes import PLANES

WIDTHS = (32, 48, 64)
CHANNELS = 5
"""Per cell: reflector logit, ghost logit, offset x, offset y (cells), log sigma of the offset (log cells)."""


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class DetectorNetwork(nn.Module):  # type: ignore[misc]
    """(n, 5, 96, 96) planes -> (n, 5, 48, 48) cells and (n,) logit of there being any reflector."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c = WIDTHS
        # Four pixels to a cell at once: the first layer then sees the whole main lobe of a point.
        self.stem = nn.Sequential(nn.PixelUnshuffle(2), _block(4 * PLANES, a), _block(a, a))
        self.down = nn.Sequential(_block(a, b, 2), _block(b, b))
        self.bottom = nn.Sequential(_block(b, c, 2), _block(c, c), _block(c, c))
        self.up = nn.ConvTranspose2d(c, b, 2, 2)
        self.join = _block(2 * b, b)
        self.top = nn.ConvTranspose2d(b, a, 2, 2)
        self.last = _block(2 * a, a)
        self.cells = nn.Conv2d(a, CHANNELS, 1)
        self.present = nn.Linear(2 * c, 1)
        # Few cells hold a reflector: starting from that rate keeps the first steps from being wasted.
        nn.init.constant_(self.cells.bias[:2], -4.0)

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        fine = self.stem(planes)
        middle = self.down(fine)
        bottom = self.bottom(middle)
        joined = self.join(torch.cat([self.up(bottom), middle], dim=1))
        joined = self.last(torch.cat([self.top(joined), fine], dim=1))
        pooled = torch.cat([bottom.amax(dim=(2, 3)), bottom.mean(dim=(2, 3))], dim=1)
        return self.cells(joined), self.present(pooled)[:, 0]
