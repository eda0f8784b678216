//! Parts of a graph that hang together.

use std::collections::BTreeMap;

/// The root of the tree that a node is in; `parents` names each node's parent, and a root itself.
fn root(parents: &mut [usize], mut at: usize) -> usize {
    while parents[at] != at {
        parents[at] = parents[parents[at]];
        at = parents[at];
    }
    at
}

/// The parts of a graph of so many nodes that `links` hold together, by the least node of each; their nodes in order.
pub fn parts(nodes: usize, links: impl Iterator<Item = (usize, usize)>) -> Vec<Vec<usize>> {
    let mut parents: Vec<usize> = (0..nodes).collect();
    for (one, other) in links {
        let (one, other) = (root(&mut parents, one), root(&mut parents, other));
        parents[one.max(other)] = one.min(other);
    }
    let mut parts: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    (0..nodes).for_each(|node| parts.entry(root(&mut parents, node)).or_default().push(node));
    parts.into_values().collect()
}

/// `[node]` number of its segment, by the least node of each, and how many there are: Felzenszwalb and Huttenlocher 2004.
///
/// `edges` are weights, of how much two nodes differ, and the nodes, the least weight first. Two segments become one where they differ by no more than
/// either does within, plus `coarseness` over its nodes; segments of fewer than `least` nodes join those they differ from least.
pub fn segments(nodes: usize, edges: &[(f32, usize, usize)], coarseness: f32, least: usize) -> (Vec<usize>, usize) {
    let mut parents: Vec<usize> = (0..nodes).collect();
    let (mut sizes, mut within) = (vec![1_usize; nodes], vec![0.0_f32; nodes]);
    for few in [false, true] {
        for (weight, a, b) in edges {
            let (a, b) = (root(&mut parents, *a), root(&mut parents, *b));
            if a == b {
                continue;
            }
            let allowed = |at: usize| within[at] + coarseness / sizes[at] as f32;
            let join = if few { sizes[a].min(sizes[b]) < least } else { *weight <= allowed(a).min(allowed(b)) };
            if join {
                parents[b] = a;
                sizes[a] += sizes[b];
                within[a] = weight.max(within[a]).max(within[b]);
            }
        }
    }
    let mut numbers = vec![usize::MAX; nodes];
    let mut count = 0;
    let segment = (0..nodes).map(|node| {
        let root = root(&mut parents, node);
        if numbers[root] == usize::MAX {
            numbers[root] = count;
            count += 1;
        }
        numbers[root]
    });
    (segment.collect(), count)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two groups of alike nodes, a weak edge between them, and a node that is too small to be a segment of its own.
    #[test]
    fn what_is_alike_is_one_segment() {
        let edges = [(0.1, 2, 3), (0.1, 0, 1), (5.0, 3, 4), (9.0, 1, 2)];
        assert_eq!(segments(5, &edges, 0.5, 1), (vec![0, 0, 1, 1, 2], 3));
        assert_eq!(segments(5, &edges, 0.5, 2), (vec![0, 0, 1, 1, 1], 2));
        assert_eq!(segments(2, &[], 0.5, 2), (vec![0, 1], 2));
    }
}
