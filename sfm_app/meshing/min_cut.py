"""The minimum cut of a graph of tetrahedra: Boykov and Kolmogorov, PAMI 2004.

Two trees of nodes grow, from the source and from the sink, over edges with capacity left. Where they meet, a path
carries as much as it can; nodes whose edge is full then look for another parent, or leave their tree.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import inlined_kernel, kernel

FREE, SOURCE, SINK = range(3)
ROOT, ORPHAN = 4, 5
"""Parents that are no neighbor: the source or the sink itself, and none."""
Nodes = NDArray[np.int32]
Slots = NDArray[np.int8]


def sink_side(neighbors: Nodes, capacity: NDArray[np.int32], excess: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (T,) the nodes on the sink's side of a minimum cut.

    The neighbors (T, 4) of a node are -1 where there is none; `capacity` (T, 4) is that of the edge to each, and is
    used up. `excess` (T,) is the capacity from the source less that to the sink.
    """
    back = np.zeros(neighbors.shape, np.int8)
    _find_back(neighbors, back)
    tree = np.zeros(len(neighbors), np.int8)
    _cut(neighbors, back, capacity, excess, tree)
    return np.asarray(tree == SINK)


@kernel
def _find_back(neighbors: Nodes, back: Slots) -> None:
    """Fill in (T, 4) the place of each node among the neighbors of its neighbor."""
    for t in range(len(neighbors)):
        for k in range(4):
            other = neighbors[t, k]
            for j in range(4):
                if other >= 0 and neighbors[other, j] == t:
                    back[t, k] = j


@kernel
def _cut(neighbors: Nodes, back: Slots, capacity: NDArray[np.int32], excess: NDArray[np.int64], tree: Slots) -> None:
    count = len(tree)
    parent, depth = np.full(count, ORPHAN, np.int8), np.zeros(count, np.int32)
    stamp, time = np.zeros(count, np.int32), 1
    queue, waits, first, last = np.empty(count + 1, np.int32), np.zeros(count, np.bool_), 0, 0
    orphans = np.empty(count, np.int32)
    for t in range(count):
        if excess[t] != 0:
            tree[t], parent[t], depth[t] = SOURCE if excess[t] > 0 else SINK, ROOT, 1
            queue[last], waits[t], last = t, True, last + 1
    while first != last:
        t = queue[first]
        met = -1
        if tree[t] != FREE:
            met, last = _grow(t, neighbors, back, capacity, tree, parent, depth, stamp, queue, waits, last)
        if met < 0:
            waits[t] = False
            first = (first + 1) % (count + 1)
            continue
        time += 1
        other = neighbors[t, met]
        if tree[t] == SOURCE:
            lost = _augment(t, met, neighbors, back, capacity, excess, parent, orphans)
        else:
            lost = _augment(other, back[t, met], neighbors, back, capacity, excess, parent, orphans)
        # the orphans are a stack: those that lose their parent later are adopted first
        while lost:
            lost -= 1
            i = orphans[lost]
            if not _adopt(i, neighbors, back, capacity, tree, parent, depth, stamp, time):
                for k in range(4):
                    o = neighbors[i, k]
                    if o < 0 or tree[o] != tree[i]:
                        continue
                    if parent[o] == back[i, k]:
                        parent[o] = ORPHAN
                        orphans[lost] = o
                        lost += 1
                    if _residual(o, back[i, k], i, k, capacity, tree) > 0 and not waits[o]:
                        queue[last], waits[o] = o, True
                        last = (last + 1) % (count + 1)
                tree[i] = FREE


@inlined_kernel
def _residual(
    parent: int, down: int, child: int, up: int, capacity: NDArray[np.int32], tree: Slots
) -> int:  # flow runs from the source down its tree, and up the tree of the sink
    """Return the capacity left between a node and a child; `down` and `up` are their places as neighbors."""
    return capacity[parent, down] if tree[parent] == SOURCE else capacity[child, up]


@inlined_kernel
def _grow(  # noqa: PLR0913
    t: int, neighbors: Nodes, back: Slots, capacity: NDArray[np.int32], tree: Slots, parent: Slots,
    depth: Nodes, stamp: Nodes, queue: Nodes, waits: NDArray[np.bool_], last: int,
) -> tuple[int, int]:  # fmt: skip
    """Add the free neighbors of a node to its tree; return the place of a neighbor in the other tree or -1, and the
    end of the queue."""
    for k in range(4):
        o = neighbors[t, k]
        if o < 0 or _residual(t, k, o, back[t, k], capacity, tree) <= 0:
            continue
        if tree[o] == FREE:
            tree[o], parent[o], depth[o], stamp[o] = tree[t], back[t, k], depth[t] + 1, stamp[t]
            if not waits[o]:
                queue[last], waits[o] = o, True
                last = (last + 1) % len(queue)
        elif tree[o] != tree[t]:
            return k, last
        elif stamp[o] <= stamp[t] and depth[o] > depth[t] + 1:  # a shorter way to the root
            parent[o], depth[o], stamp[o] = back[t, k], depth[t] + 1, stamp[t]
    return -1, last


@inlined_kernel
def _augment(
    t: int, k: int, neighbors: Nodes, back: Slots, capacity: NDArray[np.int32], excess: NDArray[np.int64],
    parent: Slots, orphans: Nodes,
) -> int:  # fmt: skip
    """Send flow through the edge from a node of the source's tree to one of the sink's; return how many orphans."""
    end = neighbors[t, k]
    flow, i = np.int64(capacity[t, k]), t
    while parent[i] != ROOT:
        p = neighbors[i, parent[i]]
        flow, i = min(flow, np.int64(capacity[p, back[i, parent[i]]])), p
    flow, i = min(flow, excess[i]), end
    while parent[i] != ROOT:
        flow, i = min(flow, np.int64(capacity[i, parent[i]])), neighbors[i, parent[i]]
    flow = min(flow, -excess[i])
    capacity[t, k] -= flow
    capacity[end, back[t, k]] += flow
    lost = 0
    for i, sign in ((t, 1), (end, -1)):
        while parent[i] != ROOT:
            p, up = neighbors[i, parent[i]], parent[i]
            down = back[i, up]
            capacity[p, down] -= sign * flow
            capacity[i, up] += sign * flow
            if (capacity[p, down] if sign > 0 else capacity[i, up]) == 0:
                parent[i] = ORPHAN
                orphans[lost] = i
                lost += 1
            i = p
        excess[i] -= sign * flow
        if excess[i] == 0:
            parent[i] = ORPHAN
            orphans[lost] = i
            lost += 1
    return lost


@inlined_kernel
def _adopt(
    i: int, neighbors: Nodes, back: Slots, capacity: NDArray[np.int32], tree: Slots, parent: Slots, depth: Nodes,
    stamp: Nodes, time: int,
) -> bool:  # fmt: skip
    """Give an orphan the neighbor that is closest to the root as its parent; return whether there is one."""
    best, least = -1, np.int32(2**31 - 1)
    for k in range(4):
        o = neighbors[i, k]
        if o < 0 or tree[o] != tree[i] or parent[o] == ORPHAN or _residual(o, back[i, k], i, k, capacity, tree) <= 0:
            continue
        steps, at = 0, o
        while stamp[at] != time and parent[at] < ROOT:
            at, steps = neighbors[at, parent[at]], steps + 1
        if parent[at] == ORPHAN:
            continue
        whole = steps + (depth[at] if stamp[at] == time else 1)
        if whole < least:
            best, least = k, whole
        at, rest = o, whole
        while stamp[at] != time:
            stamp[at], depth[at] = time, rest
            if parent[at] == ROOT:
                break
            at, rest = neighbors[at, parent[at]], rest - 1
    if best < 0:
        return False
    parent[i], depth[i], stamp[i] = best, least + 1, time
    return True
