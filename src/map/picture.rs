//! `map.png`: the map as people want to look at it, with the way the robot took.

use super::bounds::shown_bounds;
use crate::slam::grid::occupancy::OccupancyGrid;
use crate::slam::pose::Point2;

/// Cells left around what is known.
const MARGIN: usize = 8;

/// A small map is enlarged until its longer side has at least this many pixels.
const COMFORTABLE_SIDE: usize = 900;

/// Pixels a cell at most: a map of a few cells stays a picture of a few cells.
const LARGEST_SCALE: usize = 16;

/// Indices into [`PALETTE`].
const UNKNOWN: u8 = 0;
const FREE: u8 = 1;
const OCCUPIED: u8 = 2;
const PATH: u8 = 3;
const START: u8 = 4;
const END: u8 = 5;

/// Soft grey, white, near black, blue, green, red.
const PALETTE: [[u8; 3]; 6] =
    [[205, 208, 211], [255, 255, 255], [28, 32, 38], [38, 119, 201], [34, 160, 84], [212, 52, 52]];

/// The map as an 8-bit RGB PNG, cropped to free space, with `path_in_map` from its green start
/// to its red end.
///
/// # Errors
/// Only for a map of a size that PNG does not have.
pub fn png(grid: &OccupancyGrid, path_in_map: &[Point2]) -> Result<Vec<u8>, png::EncodingError> {
    let mut canvas = Canvas::of_map(grid);
    canvas.draw_path(path_in_map);
    canvas.encode()
}

/// One palette index a pixel: a third of the memory of the picture.
struct Canvas {
    width: usize,
    height: usize,
    /// Pixels a cell.
    scale: usize,
    resolution: f64,
    /// The corner of the lowest, leftmost pixel in `map`, m.
    origin: Point2,
    /// From the lowest row up, as the map.
    pixels: Vec<u8>,
}

impl Canvas {
    fn of_map(grid: &OccupancyGrid) -> Self {
        let [columns, rows] = shown_bounds(grid);
        let longer = columns.len().max(rows.len()) + 2 * MARGIN;
        let scale = COMFORTABLE_SIDE.div_ceil(longer).clamp(1, LARGEST_SCALE);
        let mut canvas = Self {
            width: (columns.len() + 2 * MARGIN) * scale,
            height: (rows.len() + 2 * MARGIN) * scale,
            scale,
            resolution: grid.resolution,
            origin: Point2::new(
                grid.origin.x + (columns.start as f64 - MARGIN as f64) * grid.resolution,
                grid.origin.y + (rows.start as f64 - MARGIN as f64) * grid.resolution,
            ),
            pixels: Vec::new(),
        };
        canvas.pixels = vec![UNKNOWN; canvas.width * canvas.height];
        for iy in rows.clone() {
            for ix in columns.clone() {
                let colour = match grid.cells[iy * grid.width + ix] {
                    0 => FREE,
                    100 => OCCUPIED,
                    _ => continue,
                };
                canvas.fill_cell(ix - columns.start + MARGIN, iy - rows.start + MARGIN, colour);
            }
        }
        canvas
    }

    fn fill_cell(&mut self, ix: usize, iy: usize, colour: u8) {
        for row in iy * self.scale..(iy + 1) * self.scale {
            let start = row * self.width + ix * self.scale;
            self.pixels[start..start + self.scale].fill(colour);
        }
    }

    fn draw_path(&mut self, path_in_map: &[Point2]) {
        let points: Vec<[f64; 2]> = path_in_map.iter().map(|&p| self.pixel_of(p)).collect();
        let thickness = 0.6 + self.scale as f64 * 0.2;
        for pair in points.windows(2) {
            self.draw_line(pair[0], pair[1], thickness);
        }
        let dot = 3.0 + self.scale as f64;
        if let (Some(&start), Some(&end)) = (points.first(), points.last()) {
            self.draw_dot(start, dot, START);
            self.draw_dot(end, dot, END);
        }
    }

    fn pixel_of(&self, point_in_map: Point2) -> [f64; 2] {
        let pixels_per_metre = self.scale as f64 / self.resolution;
        [
            (point_in_map.x - self.origin.x) * pixels_per_metre,
            (point_in_map.y - self.origin.y) * pixels_per_metre,
        ]
    }

    fn draw_line(&mut self, from: [f64; 2], to: [f64; 2], thickness: f64) {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        // No line is longer than the canvas unless its pose is off the map.
        let steps = dx.hypot(dy).ceil().clamp(1.0, (self.width + self.height) as f64);
        for step in 0..=steps as usize {
            let along = step as f64 / steps;
            self.draw_dot([from[0] + along * dx, from[1] + along * dy], thickness, PATH);
        }
    }

    fn draw_dot(&mut self, centre: [f64; 2], radius: f64, colour: u8) {
        let covered = |centre: f64, size: usize| {
            // A float that is out of range saturates: off the canvas nothing is covered.
            let first = (centre - radius).floor().max(0.0) as usize;
            first..((centre + radius).ceil().max(0.0) as usize).min(size)
        };
        for y in covered(centre[1], self.height) {
            for x in covered(centre[0], self.width) {
                let (dx, dy) = (x as f64 + 0.5 - centre[0], y as f64 + 0.5 - centre[1]);
                if dx.hypot(dy) <= radius {
                    self.pixels[y * self.width + x] = colour;
                }
            }
        }
    }

    fn encode(&self) -> Result<Vec<u8>, png::EncodingError> {
        let side = |pixels| u32::try_from(pixels).unwrap_or(u32::MAX);
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, side(self.width), side(self.height));
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        let mut stream = writer.stream_writer()?;
        for row in self.pixels.chunks_exact(self.width).rev() {
            let colours: Vec<u8> =
                row.iter().flat_map(|&index| PALETTE[usize::from(index)]).collect();
            std::io::Write::write_all(&mut stream, &colours)?;
        }
        stream.finish()?;
        drop(writer);
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(width: usize, height: usize, known: &[(usize, usize, i8)]) -> OccupancyGrid {
        let mut cells = vec![-1; width * height];
        for &(ix, iy, cell) in known {
            cells[iy * width + ix] = cell;
        }
        OccupancyGrid { resolution: 0.5, width, height, origin: Point2::new(-5.0, -5.0), cells }
    }

    fn decode(bytes: &[u8]) -> (usize, usize, Vec<u8>) {
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert_eq!(info.color_type, png::ColorType::Rgb);
        (info.width as usize, info.height as usize, pixels)
    }

    fn pixel((width, height, pixels): &(usize, usize, Vec<u8>), x: usize, y: usize) -> [u8; 3] {
        let start = ((height - 1 - y) * width + x) * 3;
        [pixels[start], pixels[start + 1], pixels[start + 2]]
    }

    #[test]
    fn the_picture_is_cropped_to_what_is_known_and_enlarged() {
        let picture =
            decode(&png(&grid(400, 300, &[(200, 100, 0), (201, 102, 100)]), &[]).unwrap());
        let scale = LARGEST_SCALE;
        let side = |cells: usize| (cells + 2 * MARGIN) * scale;
        assert_eq!((picture.0, picture.1), (side(2), side(3)));
        let colour = |ix: usize, iy: usize| {
            pixel(&picture, (ix + MARGIN) * scale + 3, (iy + MARGIN) * scale + 3)
        };
        assert_eq!(colour(0, 0), PALETTE[usize::from(FREE)]);
        assert_eq!(colour(1, 2), PALETTE[usize::from(OCCUPIED)]);
        assert_eq!(colour(1, 0), PALETTE[usize::from(UNKNOWN)]);
    }

    #[test]
    fn the_path_runs_from_a_green_start_to_a_red_end() {
        let corners: Vec<(usize, usize, i8)> = vec![(0, 0, 0), (99, 99, 0)];
        let path = [Point2::new(0.0, 0.0), Point2::new(20.0, 0.0), Point2::new(20.0, 30.0)];
        let picture = decode(&png(&grid(100, 100, &corners), &path).unwrap());
        let scale = picture.0 / (100 + 2 * MARGIN);
        let at = |x: f64, y: f64| {
            let pixels = |metres: f64| ((metres + 5.0) / 0.5 + MARGIN as f64) * scale as f64;
            pixel(&picture, pixels(x) as usize, pixels(y) as usize)
        };
        assert_eq!(at(0.0, 0.0), PALETTE[usize::from(START)]);
        assert_eq!(at(20.0, 15.0), PALETTE[usize::from(PATH)]);
        assert_eq!(at(20.0, 30.0), PALETTE[usize::from(END)]);
    }

    #[test]
    fn an_unknown_map_and_a_path_off_the_map_make_a_picture() {
        let far = [Point2::new(-1e6, 0.0), Point2::new(1e6, f64::NAN)];
        let (width, height, _) = decode(&png(&grid(3, 3, &[]), &far).unwrap());
        assert_eq!((width, height), (2 * MARGIN * LARGEST_SCALE, 2 * MARGIN * LARGEST_SCALE));
    }
}
