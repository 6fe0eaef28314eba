"""CloudChunks: a cloud that arrives in pieces, so that memory is bounded by the piece and not by the scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from gsplat_tools.cloud import GaussianCloud, concatenate

CHUNK_SIZE = 1 << 16
"""Splats a chunk: 16 MiB at SH degree 3, four blocks for the threads."""


@dataclass(frozen=True, slots=True)
class CloudChunks:
    """A cloud in chunks that can be gone through again and again.

    Parameters
    ----------
    num_splats
        Splats over all chunks.
    template
        A cloud without splats that carries the degree, the metadata, and which motion and extra arrays there are.
    iterate
        Returns a fresh iterator over the chunks, in order.
    """

    num_splats: int
    template: GaussianCloud
    iterate: Callable[[], Iterator[GaussianCloud]]

    def __len__(self) -> int:
        return self.num_splats

    def __iter__(self) -> Iterator[GaussianCloud]:
        return self.iterate()

    @property
    def sh_degree(self) -> int:
        """Highest SH band, 0 to 4."""
        return self.template.sh_degree

    def map(self, function: Callable[[GaussianCloud], GaussianCloud], *, num_splats: int | None = None) -> CloudChunks:
        """Return these chunks with `function` applied to each as it is read.

        Parameters
        ----------
        function
            Acts on splats one by one; it is also applied to the template.
        num_splats
            Splats left, where the function drops some.
        """
        source = self.iterate
        return replace(
            self,
            num_splats=self.num_splats if num_splats is None else num_splats,
            template=function(self.template),
            iterate=lambda: (function(chunk) for chunk in source()),
        )

    def read(self) -> GaussianCloud:
        """Return the whole cloud."""
        return concatenate([self.template, *self])


def as_chunks(scene: GaussianCloud | CloudChunks, size: int = CHUNK_SIZE) -> CloudChunks:
    """Return a scene as chunks; a cloud is cut into views of `size` splats."""
    if isinstance(scene, CloudChunks):
        return scene

    def iterate() -> Iterator[GaussianCloud]:
        for start in range(0, len(scene), size):
            yield scene.take(slice(start, start + size))

    return CloudChunks(len(scene), scene.take(slice(0, 0)), iterate)
