//! Rectangles of a view's sites.

use crate::multiview::DepthGrid;

/// A rectangle of a view's sites.
pub struct Window {
    /// Columns and rows.
    pub size: [usize; 2],
    low: [usize; 2],
    columns: usize,
}

impl Window {
    /// The smallest with all sites for which `wanted` says so; nothing without any.
    pub fn around(grid: &DepthGrid, wanted: impl Fn(usize) -> bool) -> Option<Self> {
        let columns = grid.columns as usize;
        let places = (0..grid.depth.len()).filter(|site| wanted(*site)).map(|site| [site % columns, site / columns]);
        let (low, high) = places.fold(([usize::MAX; 2], [0; 2]), |(low, high), at| {
            (std::array::from_fn(|a| at[a].min(low[a])), std::array::from_fn(|a: usize| at[a].max(high[a])))
        });
        (low[0] <= high[0]).then(|| Self { size: std::array::from_fn(|a| high[a] + 1 - low[a]), low, columns })
    }

    /// The view's sites in it, row by row.
    pub fn sites(&self) -> Vec<usize> {
        let Self { size: [w, h], low: [x, y], columns } = *self;
        (y..y + h).flat_map(|row| (x..x + w).map(move |column| row * columns + column)).collect()
    }
}
