"""Inspection, the result of `wrt.inspect`: a tree of rays that prints and draws itself."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from wrt.core.types import PathLike
from wrt.renderer.inspector.text import tree_text
from wrt.renderer.inspector.tree import InspectedPixel

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Inspection(InspectedPixel):
    """The rays of a pixel. `print` shows them as a tree; `radiance` is the sum over the tree.

    Parameters
    ----------
    scene
        The inspected scene, with the settings of the inspection.
    camera
        The camera of the picture.
    pixel, size
        x and y from the top left; width and height of the picture.
    seed
        Seed of the samples.
    samples
        The inspected samples: all samples of the pixel, or one.
    """

    def figure(self, view: str = "both", sample: int | None = None) -> "Figure":
        """Draw the rays of one sample.

        Parameters
        ----------
        view
            "section": the plane that holds most of the rays, with the outlines of the shapes that it cuts. "picture": the scene from
            the side, with the rays in it. "both": one beside the other.
        sample
            Index of the sample to draw. None: the first.

        Returns
        -------
        Figure
            A figure of matplotlib, which a notebook shows, and `save` writes.

        Raises
        ------
        InputError
            If matplotlib is missing, the view is unknown, the sample was not inspected, or it has no ray.
        """
        from wrt.renderer.inspector.drawing import figure  # without the drawings, an inspection imports less

        return figure(self, view, sample)

    def save(self, path: PathLike, view: str = "both", sample: int | None = None) -> None:
        """Write `figure(view, sample)` to a file: .png, .svg or .pdf. Raises InputError as `figure`, and if the file cannot be written."""
        from wrt.renderer.inspector.drawing import save

        save(self, path, view, sample)

    def __str__(self) -> str:
        return tree_text(self)
