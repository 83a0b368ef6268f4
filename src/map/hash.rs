//! Whether two maps are the same, without comparing them.

use sha2::{Digest as _, Sha256};

use crate::slam::grid::occupancy::OccupancyGrid;

/// SHA-256 of what the map says, in hexadecimal digits, however the map is written.
///
/// It covers width, height (64-bit integers), resolution, x and y of the origin (64-bit floats),
/// all little endian, and one byte a cell.
#[must_use]
pub fn content_hash(grid: &OccupancyGrid) -> String {
    let mut hash = Sha256::new();
    for count in [grid.width, grid.height] {
        hash.update((count as u64).to_le_bytes());
    }
    for metres in [grid.resolution, grid.origin.x, grid.origin.y] {
        hash.update(metres.to_le_bytes());
    }
    let mut octets = [0; 4096];
    for cells in grid.cells.chunks(octets.len()) {
        for (octet, &cell) in octets.iter_mut().zip(cells) {
            *octet = cell as u8;
        }
        hash.update(&octets[..cells.len()]);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::Point2;

    fn grid() -> OccupancyGrid {
        OccupancyGrid {
            resolution: 0.05,
            width: 3,
            height: 2,
            origin: Point2::new(-1.5, 2.5),
            cells: vec![-1, 0, 100, 0, -1, 100],
        }
    }

    /// Made with Python: `hashlib.sha256(struct.pack("<QQddd6b", 3, 2, 0.05, -1.5, 2.5, -1, 0, 100,
    /// 0, -1, 100)).hexdigest()`.
    #[test]
    fn the_hash_is_that_of_the_documented_bytes() {
        assert_eq!(
            content_hash(&grid()),
            "d16603b559e6c547d785ba214118fa0a84c95c798bbea5111379becfa1d7cead"
        );
    }

    #[test]
    fn every_part_of_a_map_changes_its_hash() {
        let changes: [fn(&mut OccupancyGrid); 6] = [
            |grid| grid.resolution = 0.1,
            |grid| grid.origin.x = -1.0,
            |grid| grid.origin.y = 2.0,
            |grid| grid.cells[5] = 0,
            |grid| (grid.width, grid.height) = (2, 3),
            |grid| grid.cells.push(0),
        ];
        let mut hashes = vec![content_hash(&grid())];
        for change in changes {
            let mut changed = grid();
            change(&mut changed);
            hashes.push(content_hash(&changed));
        }
        hashes.sort_unstable();
        hashes.dedup();
        assert_eq!(hashes.len(), 1 + changes.len());
    }

    #[test]
    fn cells_beyond_the_first_block_count() {
        let mut large = OccupancyGrid { width: 100, height: 100, cells: vec![0; 10_000], ..grid() };
        let before = content_hash(&large);
        large.cells[9_999] = 100;
        assert_ne!(content_hash(&large), before);
    }
}
