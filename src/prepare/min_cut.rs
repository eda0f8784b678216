//! The minimum cut of a graph on the pixels of a picture.
//!
//! What is dearer to cut off than to keep is decided first: a pixel whose terminal outweighs all its edges is on that side in
//! any case, and its edges become its neighbours' terminals. The rest is cut with two search trees that are kept from path
//! to path (Boykov and Kolmogorov 2004). The labelling is the same with any such algorithm: of all cheapest ones it is the one
//! with the fewest pixels on the object's side.

use std::collections::VecDeque;

/// Shifts to the neighbours of a pixel; the opposite of the `d`-th is the `d`-th from the end.
pub(super) const SHIFTS: [[isize; 2]; 8] = [[-1, -1], [0, -1], [1, -1], [-1, 0], [1, 0], [-1, 1], [0, 1], [1, 1]];

/// A graph whose nodes are pixels, each joined to its neighbours, to the object's terminal and to the background's.
///
/// Nodes are kept with a frame around the picture, as wide as the longest shift, that no edge leads to: a neighbour is at a
/// fixed distance in memory.
pub struct Grid<const N: usize> {
    size: [usize; 2],
    shifts: &'static [[isize; 2]; N],
    frame: usize,
    /// What still fits through the edge to each neighbour.
    edges: Vec<[i32; N]>,
    /// What still fits from the object's terminal, or, below zero, to the background's.
    terminal: Vec<i64>,
}

impl<const N: usize> Grid<N> {
    /// Without any edges. The opposite of shift `d` is shift `N - 1 - d`.
    pub fn new(size: [usize; 2], shifts: &'static [[isize; 2]; N]) -> Self {
        let frame = shifts.iter().flatten().map(|step| step.unsigned_abs()).max().unwrap_or(0);
        let n = (size[0] + 2 * frame) * (size[1] + 2 * frame);
        Self { size, shifts, frame, edges: vec![[0; N]; n], terminal: vec![0; n] }
    }

    /// Nodes in a row, with the frame.
    fn stride(&self) -> usize {
        self.size[0] + 2 * self.frame
    }

    /// Where a pixel is kept.
    fn node(&self, pixel: usize) -> usize {
        (pixel / self.size[0] + self.frame) * self.stride() + pixel % self.size[0] + self.frame
    }

    fn neighbour(&self, pixel: usize, direction: usize) -> Option<usize> {
        let (x, y) = ((pixel % self.size[0]) as isize, (pixel / self.size[0]) as isize);
        let [u, v] = [x + self.shifts[direction][0], y + self.shifts[direction][1]];
        let inside = u >= 0 && v >= 0 && u < self.size[0] as isize && v < self.size[1] as isize;
        inside.then(|| (v * self.size[0] as isize + u) as usize)
    }

    /// Labelling this pixel as background costs `object`, as object `background`.
    pub fn set_terminals(&mut self, pixel: usize, object: i64, background: i64) {
        let node = self.node(pixel);
        self.terminal[node] = object - background;
    }

    /// Different labels of a pixel and its neighbour in this direction cost so much, either way.
    pub fn set_edge(&mut self, pixel: usize, direction: usize, cost: i32) {
        if let Some(other) = self.neighbour(pixel, direction) {
            let [node, other] = [pixel, other].map(|pixel| self.node(pixel));
            self.edges[node][direction] = cost;
            self.edges[other][N - 1 - direction] = cost;
        }
    }

    /// Labelling this pixel as object and its neighbour in this direction as background costs so much more than the other
    /// way round.
    pub fn set_arc(&mut self, pixel: usize, direction: usize, cost: i32) {
        if self.neighbour(pixel, direction).is_some() {
            let node = self.node(pixel);
            self.edges[node][direction] = cost;
        }
    }

    /// The cheapest labelling: true on the object's side. Where both are equally cheap, the background's.
    pub fn cut(mut self) -> Vec<bool> {
        let stride = self.stride() as isize;
        let steps = self.shifts.map(|[dx, dy]| dy * stride + dx);
        let pixels: Vec<usize> = (0..self.size[0] * self.size[1]).map(|pixel| self.node(pixel)).collect();
        let mut side = self.decided(&pixels, &steps);
        let mut search = Search::new(self.edges, self.terminal, steps);
        search.run(&pixels);
        for &node in &pixels {
            if search.tree[node] == Tree::Object {
                side[node] = Some(true);
            }
        }
        pixels.iter().map(|node| side[*node] == Some(true)).collect()
    }

    /// `[node]` the side of those whose terminal outweighs their edges. They have neither any more: what an edge to them
    /// costs is added to the other node's terminal.
    fn decided(&mut self, pixels: &[usize], steps: &[isize; N]) -> Vec<Option<bool>> {
        let mut side = vec![None; self.terminal.len()];
        let mut waiting = vec![false; self.terminal.len()];
        let mut list: VecDeque<usize> = pixels.iter().copied().collect();
        list.iter().for_each(|node| waiting[*node] = true);
        while let Some(node) = list.pop_front() {
            waiting[node] = false;
            let at = |d: usize| (node as isize + steps[d]) as usize;
            // Into a node of the frame nothing leads, and out of it neither.
            let into = |d: usize| self.edges[at(d)][N - 1 - d];
            let terminal = self.terminal[node];
            let sum = |part: &dyn Fn(usize) -> i32| (0..N).map(|d| i64::from(part(d))).sum::<i64>();
            let object = terminal > 0 && terminal > sum(&|d| self.edges[node][d]);
            if !object && (terminal > 0 || -terminal < sum(&into)) {
                continue;
            }
            side[node] = Some(object);
            self.terminal[node] = 0;
            for d in 0..N {
                let other = at(d);
                let (out, back) = (self.edges[node][d], self.edges[other][N - 1 - d]);
                if out == 0 && back == 0 {
                    continue;
                }
                (self.edges[node][d], self.edges[other][N - 1 - d]) = (0, 0);
                self.terminal[other] += if object { i64::from(out) } else { -i64::from(back) };
                if side[other].is_none() && !waiting[other] {
                    waiting[other] = true;
                    list.push_back(other);
                }
            }
        }
        side
    }
}

/// The tree that a node belongs to.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Tree {
    None,
    Object,
    Background,
}

/// Where a node's way to its terminal goes on: to the neighbour in a direction, or one of these.
const ROOT: u8 = u8::MAX;
const ORPHAN: u8 = u8::MAX - 1;

/// Two trees of nodes that grow from the terminals until nothing fits from one to the other.
struct Search<const N: usize> {
    edges: Vec<[i32; N]>,
    terminal: Vec<i64>,
    steps: [isize; N],
    tree: Vec<Tree>,
    parent: Vec<u8>,
    /// The last time at which the way from the node to its terminal was walked, and how long it was.
    walked: Vec<(u32, u32)>,
    now: u32,
    active: VecDeque<u32>,
    is_active: Vec<bool>,
    orphans: VecDeque<u32>,
}

impl<const N: usize> Search<N> {
    fn new(edges: Vec<[i32; N]>, terminal: Vec<i64>, steps: [isize; N]) -> Self {
        let n = terminal.len();
        Self {
            edges,
            terminal,
            steps,
            tree: vec![Tree::None; n],
            parent: vec![ORPHAN; n],
            walked: vec![(0, 0); n],
            now: 0,
            active: VecDeque::new(),
            is_active: vec![false; n],
            orphans: VecDeque::new(),
        }
    }

    fn at(&self, node: usize, d: usize) -> usize {
        (node as isize + self.steps[d]) as usize
    }

    fn activate(&mut self, node: usize) {
        if !self.is_active[node] {
            self.is_active[node] = true;
            self.active.push_back(node as u32);
        }
    }

    /// What fits along the edge to the neighbour in a direction, seen from a tree: away from the object's terminal, towards the
    /// background's.
    fn fits(&self, tree: Tree, node: usize, d: usize) -> i32 {
        match tree {
            Tree::Background => self.edges[self.at(node, d)][N - 1 - d],
            _ => self.edges[node][d],
        }
    }

    fn run(&mut self, pixels: &[usize]) {
        for &node in pixels.iter().filter(|node| self.terminal[**node] != 0) {
            self.tree[node] = if self.terminal[node] > 0 { Tree::Object } else { Tree::Background };
            self.parent[node] = ROOT;
            self.is_active[node] = true;
            self.active.push_back(node as u32);
        }
        let mut current = None;
        loop {
            let node = match current.take() {
                Some(node) => node,
                None => match self.active.pop_front() {
                    Some(node) => {
                        self.is_active[node as usize] = false;
                        node as usize
                    }
                    None => return,
                },
            };
            if self.tree[node] == Tree::None {
                continue;
            }
            if let Some(bridge) = self.grow(node) {
                self.now += 1;
                self.augment(bridge);
                while let Some(orphan) = self.orphans.pop_front() {
                    self.adopt(orphan as usize);
                }
                // It may touch the other tree elsewhere, too.
                current = Some(node);
            }
        }
    }

    /// Lets a node's tree grow from it; returns the edge (from the object's tree, its direction) over which it touches the
    /// other one.
    fn grow(&mut self, node: usize) -> Option<(usize, usize)> {
        let tree = self.tree[node];
        for d in 0..N {
            if self.fits(tree, node, d) == 0 {
                continue;
            }
            let other = self.at(node, d);
            let (time, length) = self.walked[node];
            if self.tree[other] == Tree::None {
                self.tree[other] = tree;
                self.parent[other] = (N - 1 - d) as u8;
                self.walked[other] = (time, length + 1);
                self.activate(other);
            } else if self.tree[other] != tree {
                return Some(if tree == Tree::Object { (node, d) } else { (other, N - 1 - d) });
            } else if self.parent[other] != ROOT && self.walked[other].0 <= time && self.walked[other].1 > length + 1 {
                // A shorter way.
                self.parent[other] = (N - 1 - d) as u8;
                self.walked[other] = (time, length + 1);
            }
        }
        None
    }

    /// Sends what fits from terminal to terminal over an edge between the trees.
    fn augment(&mut self, (from, d): (usize, usize)) {
        let ends = [from, self.at(from, d)];
        let mut fits = i64::from(self.edges[from][d]);
        for mut node in ends {
            while self.parent[node] != ROOT {
                let up = usize::from(self.parent[node]);
                let tree = self.tree[node];
                node = self.at(node, up);
                fits = fits.min(self.fits(tree, node, N - 1 - up).into());
            }
            fits = fits.min(self.terminal[node].abs());
        }
        self.send(from, d, fits as i32);
        for mut node in ends {
            while self.parent[node] != ROOT {
                let up = usize::from(self.parent[node]);
                let (tree, above) = (self.tree[node], self.at(node, up));
                let left = if tree == Tree::Object {
                    self.send(above, N - 1 - up, fits as i32)
                } else {
                    self.send(node, up, fits as i32)
                };
                if left == 0 {
                    self.parent[node] = ORPHAN;
                    self.orphans.push_back(node as u32);
                }
                node = above;
            }
            self.terminal[node] -= self.terminal[node].signum() * fits;
            if self.terminal[node] == 0 {
                self.parent[node] = ORPHAN;
                self.orphans.push_back(node as u32);
            }
        }
    }

    /// Sends a flow along an edge; returns what still fits. A flow is at most the least capacity of its path.
    fn send(&mut self, node: usize, d: usize, flow: i32) -> i32 {
        let other = self.at(node, d);
        self.edges[node][d] -= flow;
        self.edges[other][N - 1 - d] += flow;
        self.edges[node][d]
    }

    /// How far the node is from its terminal; nothing where its way ends at an orphan.
    fn distance(&mut self, node: usize) -> Option<u32> {
        let (mut at, mut length) = (node, 0);
        let known = loop {
            if self.walked[at].0 == self.now && self.parent[at] != ORPHAN {
                break self.walked[at].1;
            }
            match self.parent[at] {
                ROOT => {
                    self.walked[at] = (self.now, 0);
                    break 0;
                }
                ORPHAN => return None,
                up => at = self.at(at, usize::from(up)),
            }
            length += 1;
        };
        let whole = known + length;
        // What was walked is known for the next that ask.
        let (mut at, mut left) = (node, whole);
        while self.walked[at].0 != self.now {
            self.walked[at] = (self.now, left);
            left -= 1;
            at = self.at(at, usize::from(self.parent[at]));
        }
        Some(whole)
    }

    /// Finds an orphan the neighbour with the shortest way to its terminal; without one it leaves its tree.
    fn adopt(&mut self, node: usize) {
        let tree = self.tree[node];
        let mut best: Option<(u32, usize)> = None;
        for d in 0..N {
            let other = self.at(node, d);
            if self.tree[other] != tree || self.fits(tree, other, N - 1 - d) == 0 {
                continue;
            }
            if let Some(length) = self.distance(other)
                && best.is_none_or(|(least, _)| length < least)
            {
                best = Some((length, d));
            }
        }
        if let Some((length, d)) = best {
            self.parent[node] = d as u8;
            self.walked[node] = (self.now, length + 1);
            return;
        }
        for d in 0..N {
            let other = self.at(node, d);
            if self.tree[other] != tree {
                continue;
            }
            if self.fits(tree, other, N - 1 - d) > 0 {
                self.activate(other);
            }
            let parent = self.parent[other];
            if parent < ORPHAN && self.at(other, usize::from(parent)) == node {
                self.parent[other] = ORPHAN;
                self.orphans.push_back(other as u32);
            }
        }
        self.tree[node] = Tree::None;
    }
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use rand_pcg::Pcg64;

    use super::*;

    /// All labellings of a small grid, by their cost.
    fn cheapest(size: [usize; 2], terminals: &[[i64; 2]], edges: &[(usize, usize, i32)]) -> Vec<u32> {
        let n = size[0] * size[1];
        let cost = |labels: u32| {
            let on = |i: usize| labels >> i & 1 == 1;
            let own: i64 = (0..n).map(|i| terminals[i][usize::from(on(i))]).sum();
            own + edges.iter().filter(|(i, j, _)| on(*i) && !on(*j)).map(|e| i64::from(e.2)).sum::<i64>()
        };
        let least = (0..1u32 << n).map(cost).min().unwrap();
        (0..1 << n).filter(|l| cost(*l) == least).collect()
    }

    /// Random grids of 3 x 4 against every one of their 4,096 labellings; every other with edges that cost one way alone.
    #[test]
    fn the_cut_is_the_cheapest_labelling() {
        let mut rng = Pcg64::new(5, 5);
        let size = [3, 4];
        for round in 0..400 {
            let mut grid = Grid::new(size, &SHIFTS);
            let (mut terminals, mut edges) = (vec![], vec![]);
            for i in 0..12 {
                // Of background and of object.
                let costs = [rng.random_range(0..9i64), rng.random_range(0..9i64)];
                grid.set_terminals(i, costs[0], costs[1]);
                terminals.push(costs);
                for d in 4..8 {
                    let cost = rng.random_range(0..6);
                    if let Some(j) = grid.neighbour(i, d) {
                        if round % 2 == 0 {
                            grid.set_edge(i, d, cost);
                            edges.push((j, i, cost));
                        } else {
                            grid.set_arc(i, d, cost);
                        }
                        edges.push((i, j, cost));
                    }
                }
            }
            let best = cheapest(size, &terminals, &edges);
            let labels = grid.cut().iter().enumerate().map(|(i, on)| u32::from(*on) << i).sum::<u32>();
            let fewest = best.iter().fold(u32::MAX, |all, labels| all & labels);
            assert!(best.contains(&fewest));
            assert_eq!(labels, fewest, "of {best:?}");
        }
    }

    /// The nodes on the object's side by shortest augmenting paths in a matrix of capacities, whose last two nodes are the
    /// terminals of object and background.
    fn by_shortest_paths(mut fits: Vec<Vec<i64>>) -> Vec<bool> {
        let n = fits.len();
        let (object, background) = (n - 2, n - 1);
        loop {
            let mut from = vec![None; n];
            from[object] = Some(object);
            let mut queue = VecDeque::from([object]);
            while let Some(a) = queue.pop_front() {
                for b in (0..n).filter(|b| fits[a][*b] > 0) {
                    if from[b].is_none() {
                        from[b] = Some(a);
                        queue.push_back(b);
                    }
                }
            }
            if from[background].is_none() {
                return from[..n - 2].iter().map(Option::is_some).collect();
            }
            let way: Vec<(usize, usize)> = std::iter::successors(Some(background), |b| from[*b].filter(|a| a != b))
                .filter(|b| *b != object)
                .map(|b| (from[b].unwrap(), b))
                .collect();
            let flow = way.iter().map(|(a, b)| fits[*a][*b]).min().unwrap();
            for (a, b) in way {
                fits[a][b] -= flow;
                fits[b][a] += flow;
            }
        }
    }

    /// Larger grids, on which trees lose branches and find them again: weak terminals, edges of one way and of both, many of
    /// the same cost.
    #[test]
    fn the_cut_is_that_of_another_algorithm() {
        let mut rng = Pcg64::new(9, 9);
        let size = [11, 8];
        let n = size[0] * size[1];
        let mut sides = [0, 0];
        for round in 0..200 {
            let mut grid = Grid::new(size, &SHIFTS);
            let mut fits = vec![vec![0i64; n + 2]; n + 2];
            let mut join = |from: usize, to: usize, cost: i64| fits[from][to] = cost;
            let strong = [3, 20, 60][round % 3];
            for i in 0..n {
                let costs = [rng.random_range(0..strong), rng.random_range(0..strong)];
                grid.set_terminals(i, costs[0], costs[1]);
                join(n, i, costs[0]);
                join(i, n + 1, costs[1]);
                for d in 4..8 {
                    let cost = rng.random_range(0..7);
                    let Some(j) = grid.neighbour(i, d) else { continue };
                    join(i, j, cost.into());
                    if round % 2 == 0 {
                        grid.set_edge(i, d, cost);
                        join(j, i, cost.into());
                    } else {
                        grid.set_arc(i, d, cost);
                    }
                }
            }
            let labels = grid.cut();
            labels.iter().for_each(|on| sides[usize::from(*on)] += 1);
            assert_eq!(labels, by_shortest_paths(fits), "round {round}");
        }
        assert!(sides.iter().all(|side| *side > 2000), "{sides:?}");
    }
}
