//! `map.pgm` and `map.yaml` as nav2's `map_saver` writes them in trinary mode.

use std::fmt::Write as _;

use crate::slam::grid::occupancy::OccupancyGrid;

const FREE: u8 = 254;
const OCCUPIED: u8 = 0;
const UNKNOWN: u8 = 205;

/// The thresholds at which nav2's `map_server` reads the three grey values back as they were.
const OCCUPIED_THRESHOLD: f64 = 0.65;
const FREE_THRESHOLD: f64 = 0.196;

/// The map as a binary PGM, the topmost row first.
#[must_use]
pub fn pgm(grid: &OccupancyGrid) -> Vec<u8> {
    let mut bytes = format!("P5\n{} {}\n255\n", grid.width, grid.height).into_bytes();
    bytes.reserve_exact(grid.cells.len());
    for row in grid.cells.chunks_exact(grid.width.max(1)).rev() {
        bytes.extend(row.iter().map(|&cell| grey(cell)));
    }
    bytes
}

/// The YAML file that goes with `image`, whatever that is called; resolution and origin read back
/// as the same floats.
#[must_use]
pub fn yaml(grid: &OccupancyGrid, image: &str) -> String {
    let mut text = String::new();
    let origin = grid.origin;
    writeln!(text, "image: {}", scalar(image)).ok();
    writeln!(text, "mode: trinary").ok();
    writeln!(text, "resolution: {}", grid.resolution).ok();
    writeln!(text, "origin: [{}, {}, 0]", origin.x, origin.y).ok();
    writeln!(text, "negate: 0").ok();
    writeln!(text, "occupied_thresh: {OCCUPIED_THRESHOLD}").ok();
    writeln!(text, "free_thresh: {FREE_THRESHOLD}").ok();
    text
}

/// A name as YAML takes it: in quotes where a character could mean something else.
fn scalar(name: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "._-/".contains(c);
    let begins_plainly = name.starts_with(|c: char| c.is_ascii_alphabetic());
    if begins_plainly && name.chars().all(plain) {
        name.to_owned()
    } else {
        // A JSON string is a YAML string.
        serde_json::Value::from(name).to_string()
    }
}

const fn grey(cell: i8) -> u8 {
    match cell {
        0 => FREE,
        100 => OCCUPIED,
        _ => UNKNOWN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::Point2;

    fn grid() -> OccupancyGrid {
        OccupancyGrid {
            resolution: 0.0254,
            width: 3,
            height: 2,
            origin: Point2::new(-1.234_567_890_123, 0.1),
            cells: vec![-1, 0, 100, 0, 0, 0],
        }
    }

    #[test]
    fn rows_run_from_the_top_and_pixels_are_those_of_nav2() {
        assert_eq!(pgm(&grid()), b"P5\n3 2\n255\n\xfe\xfe\xfe\xcd\xfe\x00");
    }

    #[test]
    fn the_yaml_keeps_full_precision() {
        assert_eq!(
            yaml(&grid(), "map.pgm"),
            "image: map.pgm\nmode: trinary\nresolution: 0.0254\n\
             origin: [-1.234567890123, 0.1, 0]\nnegate: 0\n\
             occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        );
    }

    #[test]
    fn any_name_of_the_image_reads_back() {
        for name in ["map.pgm", "maps/a-b_c.pgm", "a: b #c.pgm", "- x", "\"q\" 'r'", "1e3", "Küche"]
        {
            let text = yaml(&grid(), name);
            let file: serde_json::Value = serde_saphyr::from_str(&text).unwrap();
            assert_eq!(file["image"], name);
        }
        assert!(yaml(&grid(), "maps/a-b_c.pgm").starts_with("image: maps/a-b_c.pgm\n"));
    }

    /// The pixel values decide what nav2 loads: p = (255 - pixel) / 255 against the thresholds.
    #[test]
    fn each_pixel_reads_back_as_its_cell() {
        let probability = |pixel: u8| f64::from(255 - pixel) / 255.0;
        assert!(probability(FREE) < FREE_THRESHOLD);
        assert!(probability(OCCUPIED) > OCCUPIED_THRESHOLD);
        let unknown = probability(UNKNOWN);
        assert!(unknown > FREE_THRESHOLD && unknown < OCCUPIED_THRESHOLD);
    }
}
