"""The minimum cut of a graph of tetrahedra: Boykov and Kolmogorov, PAMI 2004.

Two trees of nodes grow, from the source and from the sink, along edges with capacity left. Where they meet, a path
carries as much as it can. Nodes behind a full edge then look for another parent, or leave their tree.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import inlined_kernel, kernel

FREE, SOURCE, SINK = range(3)
ROOT, ORPHAN = 4, 5
"""Places of a parent that is the source or the sink itself, and of none."""


class Forest(NamedTuple):
    """A graph with up to four neighbors of each node, and its trees."""

    neighbors: NDArray[np.int32]
    """(T, 4) nodes, -1 for none."""
    back: NDArray[np.int8]
    """(T, 4) place of each node among the neighbors of its neighbor."""
    capacity: NDArray[np.int32]
    """(T, 4) left to each neighbor."""
    excess: NDArray[np.int64]
    """(T,) capacity left from the source; to the sink where negative."""
    tree: NDArray[np.int8]
    """(T,) FREE, SOURCE or SINK."""
    parent: NDArray[np.int8]
    """(T,) its place among the neighbors, ROOT or ORPHAN."""
    depth: NDArray[np.int32]
    """(T,) nodes to the root, as of the time of the stamp."""
    stamp: NDArray[np.int32]
    """(T,)."""
    orphans: NDArray[np.int32]
    """(T,) a stack."""


def sink_side(
    neighbors: NDArray[np.int32], capacity: NDArray[np.int32], excess: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return (T,) the nodes on the sink's side of a minimum cut.

    The neighbors (T, 4) of a node are -1 where there is none; `capacity` (T, 4) is that of the edge to each, and is
    used up. `excess` (T,) is the capacity from the source less that to the sink, and is used up as well.
    """
    count = len(neighbors)
    back, tree, parent = np.zeros((count, 4), np.int8), np.zeros(count, np.int8), np.full(count, ORPHAN, np.int8)
    _find_back(neighbors, back)
    numbers = [np.zeros(count, np.int32) for _ in range(3)]
    _cut(Forest(neighbors, back, capacity, excess, tree, parent, *numbers))
    return np.asarray(tree == SINK)


@kernel
def _find_back(neighbors: NDArray[np.int32], back: NDArray[np.int8]) -> None:
    for t in range(len(neighbors)):
        for k in range(4):
            other = neighbors[t, k]
            for j in range(4):
                if other >= 0 and neighbors[other, j] == t:
                    back[t, k] = j


@kernel
def _cut(forest: Forest) -> None:
    """Fill in the trees: the sink's side of a minimum cut is the sink's tree."""
    tree, count = forest.tree, len(forest.tree)
    # nodes whose neighbors may join their tree, in a ring
    queue, waits, first, last, time = np.empty(count + 1, np.int32), np.zeros(count, np.bool_), 0, 0, 1
    for t in range(count):
        if forest.excess[t] != 0:
            tree[t], forest.parent[t] = SOURCE if forest.excess[t] > 0 else SINK, ROOT
            forest.depth[t], queue[last], waits[t], last = 1, t, True, last + 1
    while first != last:
        t, met = queue[first], -1
        if tree[t] != FREE:
            met, last = _grow(forest, t, queue, waits, last)
        if met < 0:
            waits[t] = False
            first = (first + 1) % len(queue)
            continue
        time += 1
        other = forest.neighbors[t, met]
        lost = _augment(forest, t, met) if tree[t] == SOURCE else _augment(forest, other, forest.back[t, met])
        while lost:
            i = forest.orphans[lost - 1]
            lost -= 1
            if not _adopt(forest, i, time):
                lost, last = _leave(forest, i, lost, queue, waits, last)


@inlined_kernel
def _left(forest: Forest, parent: int, down: int) -> int:
    """Return the capacity left between a node and the neighbor at the place `down`, its child.

    Flow runs down the source's tree, and up the sink's.
    """
    if forest.tree[parent] == SOURCE:
        return int(forest.capacity[parent, down])
    return int(forest.capacity[forest.neighbors[parent, down], forest.back[parent, down]])


@inlined_kernel
def _grow(forest: Forest, t: int, queue: NDArray[np.int32], waits: NDArray[np.bool_], last: int) -> tuple[int, int]:
    """Add free neighbors of a node to its tree; return the place of a neighbor in the other tree or -1, and `last`."""
    tree, depth, stamp = forest.tree, forest.depth, forest.stamp
    for k in range(4):
        o = forest.neighbors[t, k]
        if o < 0 or _left(forest, t, k) <= 0:
            continue
        if tree[o] == FREE:
            tree[o], forest.parent[o], depth[o], stamp[o] = tree[t], forest.back[t, k], depth[t] + 1, stamp[t]
            if not waits[o]:
                queue[last], waits[o], last = o, True, (last + 1) % len(queue)
        elif tree[o] != tree[t]:
            return k, last
        elif stamp[o] <= stamp[t] and depth[o] > depth[t] + 1:  # a shorter way to the root
            forest.parent[o], depth[o], stamp[o] = forest.back[t, k], depth[t] + 1, stamp[t]
    return -1, last


@inlined_kernel
def _augment(forest: Forest, start: int, place: int) -> int:
    """Send flow from the source's tree through a neighbor in the sink's; return how many nodes lose their parent."""
    neighbors, back, capacity = forest.neighbors, forest.back, forest.capacity
    excess, parent = forest.excess, forest.parent
    end = neighbors[start, place]
    flow = np.int64(capacity[start, place])
    i = start
    while parent[i] != ROOT:
        flow, i = min(flow, np.int64(capacity[neighbors[i, parent[i]], back[i, parent[i]]])), neighbors[i, parent[i]]
    flow = min(flow, excess[i])
    i = end
    while parent[i] != ROOT:
        flow, i = min(flow, np.int64(capacity[i, parent[i]])), neighbors[i, parent[i]]
    flow = min(flow, -excess[i])
    capacity[start, place] -= flow
    capacity[end, back[start, place]] += flow
    lost = 0
    for sign in (1, -1):
        i = start if sign > 0 else end
        while True:
            up = parent[i]
            if up == ROOT:
                excess[i] -= sign * flow
                left, above = excess[i], -1
            else:
                above = neighbors[i, up]
                capacity[above, back[i, up]] -= sign * flow
                capacity[i, up] += sign * flow
                left = np.int64(capacity[above, back[i, up]] if sign > 0 else capacity[i, up])
            if left == 0:
                parent[i], forest.orphans[lost] = ORPHAN, i
                lost += 1
            if above < 0:
                break
            i = above
    return lost


@inlined_kernel
def _adopt(forest: Forest, i: int, time: int) -> bool:
    """Give an orphan the neighbor that is closest to the root as its parent; return whether there is one."""
    neighbors, parent, depth, stamp = forest.neighbors, forest.parent, forest.depth, forest.stamp
    best, least = -1, 0
    for k in range(4):
        o = neighbors[i, k]
        if o < 0 or forest.tree[o] != forest.tree[i] or parent[o] == ORPHAN or _left(forest, o, forest.back[i, k]) <= 0:
            continue
        steps, at = 0, o
        while stamp[at] != time and parent[at] < ROOT:
            at, steps = neighbors[at, parent[at]], steps + 1
        if parent[at] == ORPHAN:
            continue
        whole = steps + (depth[at] if stamp[at] == time else 1)
        if best < 0 or whole < least:
            best, least = k, whole
        at = o
        while stamp[at] != time:
            stamp[at], depth[at] = time, whole
            whole -= 1
            if parent[at] == ROOT:
                break
            at = neighbors[at, parent[at]]
    if best >= 0:
        parent[i], depth[i], stamp[i] = best, least + 1, time
    return best >= 0


@inlined_kernel
def _leave(
    forest: Forest, i: int, lost: int, queue: NDArray[np.int32], waits: NDArray[np.bool_], last: int
) -> tuple[int, int]:
    """Take a node out of its tree; return the numbers of orphans with its children, and the end of the queue.

    Its neighbors in the tree may take it in again.
    """
    for k in range(4):
        o, place = forest.neighbors[i, k], forest.back[i, k]
        if o < 0 or forest.tree[o] != forest.tree[i]:
            continue
        if forest.parent[o] == place:
            forest.parent[o], forest.orphans[lost] = ORPHAN, o
            lost += 1
        if _left(forest, o, place) > 0 and not waits[o]:
            queue[last], waits[o], last = o, True, (last + 1) % len(queue)
    forest.tree[i] = FREE
    return lost, last
