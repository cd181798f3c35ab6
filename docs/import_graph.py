"""Draw which folder imports which: python docs/import_graph.py [FILE], for ARCHITECTURE.md.

A folder stands above every folder that it imports. Only direct imports that no other path explains
are drawn (the transitive reduction), so that the picture stays readable.
"""

from __future__ import annotations

import sys
from pathlib import Path

import grimp
import matplotlib.pyplot as plt
import networkx as nx

DEFAULT = Path(__file__).parent / "pictures" / "imports.png"
OPENED = ("telerig.estimator", "telerig.io")
"""Folders that are shown as their inner folders."""
COLOURS = {"rig": "#d9ead3", "factors": "#fce5cd", "io": "#d0e0f0", "estimator": "#fff2cc"}


def folder_of(module: str) -> str:
    """The folder that a module is shown in; "" for modules beside the folders."""
    parts = module.split(".")
    depth = 3 if ".".join(parts[:2]) in OPENED else 2
    return ".".join(parts[1:depth])


def folder_graph() -> nx.DiGraph:
    """Folder -> folder, with the number of module imports."""
    modules = grimp.build_graph("telerig")
    graph: nx.DiGraph = nx.DiGraph()
    for importer in modules.modules:
        for imported in modules.find_modules_directly_imported_by(importer):
            a, b = folder_of(importer), folder_of(imported)
            if a and b and a != b and not {a, b} & {"errors", "version", "io", "estimator"}:
                count = graph.edges[a, b]["imports"] + 1 if graph.has_edge(a, b) else 1
                graph.add_edge(a, b, imports=count)
    return graph


def draw(graph: nx.DiGraph, file: Path) -> None:
    """Floors from the bottom: a folder stands one floor above the highest that it imports."""
    floors: dict[str, int] = {}
    for folder in reversed(list(nx.topological_sort(graph))):
        floors[folder] = 1 + max((floors[b] for b in graph.successors(folder)), default=-1)
    place = {}
    for floor in sorted(set(floors.values())):
        here = sorted(f for f, n in floors.items() if n == floor)
        for i, folder in enumerate(here):
            place[folder] = ((i - (len(here) - 1) / 2) * 2.6 + 0.5 * (floor % 2), floor)
    figure, axes = plt.subplots(figsize=(11, 0.85 * len(set(floors.values())) + 1))
    for a, b in nx.transitive_reduction(graph).edges:
        arrow = {"arrowstyle": "->", "color": "#777777", "shrinkA": 12, "shrinkB": 12}
        axes.annotate("", place[b], place[a], arrowprops=arrow)
    for folder, (x, y) in place.items():
        colour = COLOURS.get(folder.split(".")[0], "#eeeeee")
        box = {"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": "#888888"}
        axes.text(x, y, folder.replace(".", "/"), ha="center", va="center", fontsize=9, bbox=box)
    axes.set_xlim(min(x for x, _ in place.values()) - 1.5, max(x for x, _ in place.values()) + 1.5)
    axes.set_ylim(-0.6, max(floors.values()) + 0.6)
    axes.axis("off")
    figure.savefig(file, dpi=130, bbox_inches="tight")
    sys.stdout.write(
        f"{graph.number_of_nodes()} folders, {graph.number_of_edges()} arrows: {file}\n"
    )


if __name__ == "__main__":
    draw(folder_graph(), Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT)
