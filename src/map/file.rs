//! A map that was saved as PGM and YAML, read again as nav2's `map_server` reads it.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use thiserror::Error;

use crate::slam::grid::occupancy::OccupancyGrid;
use crate::slam::pose::Point2;

/// A map with more cells along a side is a mistake.
const MOST_CELLS: usize = 32_768;

/// Why a map cannot be read.
#[derive(Debug, Error)]
pub enum MapFileError {
    /// A file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The YAML is none, or has a key with another value than it may have.
    #[error("{}: {reason}", path.display())]
    Description {
        /// The file.
        path: PathBuf,
        /// What is wrong, with the key.
        reason: String,
    },
    /// The image is no binary PGM.
    #[error("{}: {reason}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

/// The YAML file, with `map_server`'s names.
#[derive(Debug, Deserialize)]
struct Description {
    image: PathBuf,
    resolution: f64,
    origin: [f64; 3],
    #[serde(default)]
    mode: PixelMode,
    #[serde(default)]
    negate: serde_json::Value,
    #[serde(default = "occupied")]
    occupied_thresh: f64,
    #[serde(default = "free")]
    free_thresh: f64,
}

/// What a pixel means.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
enum PixelMode {
    /// Free, occupied or unknown.
    #[default]
    Trinary,
    /// How likely occupied, between the thresholds.
    Scale,
    /// The value itself; above 100, unknown.
    Raw,
}

const fn occupied() -> f64 {
    0.65
}

const fn free() -> f64 {
    0.25
}

/// Reads a map: `yaml` names the image, which is sought beside it.
///
/// Cells have 0 (free) to 100 (occupied), or -1 (unknown); between are those of `mode: scale` and
/// `mode: raw` alone.
///
/// # Errors
/// When a file cannot be read, is not what it has to be, or the map is turned.
pub fn read(yaml: &Path) -> Result<OccupancyGrid, MapFileError> {
    let wrong = |reason: String| MapFileError::Description { path: yaml.to_owned(), reason };
    let text =
        String::from_utf8(bytes_of(yaml)?).map_err(|error| wrong(format!("no text: {error}")))?;
    let description: Description =
        serde_saphyr::from_str(&text).map_err(|error| wrong(first_line(&error.to_string())))?;
    let Description { resolution, origin: [x, y, yaw], .. } = description;
    if !(resolution.is_finite() && resolution > 0.0) {
        return Err(wrong(format!("resolution is {resolution}; it is metres a cell, above 0")));
    }
    if !(x.is_finite() && y.is_finite()) {
        return Err(wrong(format!("origin is [{x}, {y}, {yaw}]; finite metres are needed")));
    }
    if yaw != 0.0 {
        return Err(wrong(format!(
            "origin has a yaw of {yaw} rad, and maps that are turned are not taken; turn the image"
        )));
    }
    let dark = dark(&description.negate)
        .ok_or_else(|| wrong(format!("negate is {}; 0 or 1 is needed", description.negate)))?;
    let image = yaml.parent().unwrap_or(Path::new("")).join(&description.image);
    let pixels = Pixels::parse(&bytes_of(&image)?)
        .map_err(|reason| MapFileError::Image { path: image, reason: reason.to_owned() })?;
    let cell = |&pixel: &u8| description.cell(pixel, pixels.white, dark);
    Ok(OccupancyGrid {
        resolution,
        width: pixels.width,
        height: pixels.height,
        origin: Point2::new(x, y),
        cells: pixels.values.chunks_exact(pixels.width).rev().flatten().map(cell).collect(),
    })
}

fn bytes_of(path: &Path) -> Result<Vec<u8>, MapFileError> {
    std::fs::read(path).map_err(|source| MapFileError::Read { path: path.to_owned(), source })
}

/// Parsers show the text below what they say.
fn first_line(text: &str) -> String {
    text.lines().next().unwrap_or_default().to_owned()
}

/// What dark pixels are.
#[derive(Debug, Clone, Copy)]
enum Dark {
    Occupied,
    /// `negate: 1`.
    Free,
}

/// Both 0 and 1, and false and true, are written.
fn dark(negate: &serde_json::Value) -> Option<Dark> {
    match negate {
        serde_json::Value::Null | serde_json::Value::Bool(false) => Some(Dark::Occupied),
        serde_json::Value::Bool(true) => Some(Dark::Free),
        other => match other.as_u64()? {
            0 => Some(Dark::Occupied),
            1 => Some(Dark::Free),
            _ => None,
        },
    }
}

impl Description {
    fn cell(&self, pixel: u8, white: u8, dark: Dark) -> i8 {
        if matches!(self.mode, PixelMode::Raw) {
            return if pixel <= 100 { pixel as i8 } else { -1 };
        }
        let share = f64::from(pixel) / f64::from(white);
        let occupied = match dark {
            Dark::Occupied => 1.0 - share,
            Dark::Free => share,
        };
        if occupied > self.occupied_thresh {
            return 100;
        }
        if occupied < self.free_thresh {
            return 0;
        }
        match self.mode {
            PixelMode::Scale => {
                let range = self.occupied_thresh - self.free_thresh;
                libm::round(1.0 + 98.0 * (occupied - self.free_thresh) / range.max(1e-9)) as i8
            }
            PixelMode::Trinary | PixelMode::Raw => -1,
        }
    }
}

/// A grey picture, the topmost row first.
#[derive(Debug)]
struct Pixels {
    width: usize,
    height: usize,
    /// The brightest value.
    white: u8,
    values: Vec<u8>,
}

impl Pixels {
    fn parse(bytes: &[u8]) -> Result<Self, &'static str> {
        let mut rest =
            bytes.strip_prefix(b"P5").ok_or("it is no binary PGM, which begins with P5")?;
        let mut number = || {
            let value;
            (value, rest) = header_number(rest)?;
            Some(value)
        };
        let sizes = (number(), number(), number());
        let (Some(width), Some(height), Some(white)) = sizes else {
            return Err("its head has no width, height and largest value");
        };
        let sides = 1..=MOST_CELLS;
        if !sides.contains(&width) || !sides.contains(&height) {
            return Err("its width and height have to be from 1 to 32768");
        }
        let white = u8::try_from(white).ok().filter(|white| *white > 0);
        let white = white.ok_or("its largest value has to be from 1 to 255")?;
        // One blank ends the head.
        let values = rest.get(1..).and_then(|values| values.get(..width * height));
        let values = values.ok_or("it is cut off: there are fewer pixels than its head says")?;
        Ok(Self { width, height, white, values: values.to_vec() })
    }
}

/// The next number of a PGM's head and what follows; comments run from # to the end of the line.
fn header_number(mut bytes: &[u8]) -> Option<(usize, &[u8])> {
    loop {
        match bytes.first()? {
            b'#' => bytes = &bytes[bytes.iter().position(|byte| *byte == b'\n')?..],
            byte if byte.is_ascii_whitespace() => bytes = &bytes[1..],
            _ => break,
        }
    }
    let digits = bytes.iter().take_while(|byte| byte.is_ascii_digit()).count();
    let value = std::str::from_utf8(&bytes[..digits]).ok()?.parse().ok()?;
    Some((value, &bytes[digits..]))
}

#[cfg(test)]
mod tests {
    use super::super::{pgm, yaml};
    use super::*;

    /// Reads an image and a description from a folder of their own.
    fn read_back(name: &str, image: &[u8], text: &str) -> Result<OccupancyGrid, String> {
        let folder = std::env::temp_dir().join(format!("gmapd-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("map.pgm"), image).unwrap();
        std::fs::write(folder.join("map.yaml"), text).unwrap();
        let grid = read(&folder.join("map.yaml"));
        std::fs::remove_dir_all(&folder).unwrap();
        grid.map_err(|error| error.to_string())
    }

    fn grid() -> OccupancyGrid {
        OccupancyGrid {
            resolution: 0.0254,
            width: 3,
            height: 2,
            origin: Point2::new(-1.234_567_890_123, 0.1),
            cells: vec![-1, 0, 100, 0, 0, 0],
        }
    }

    const HEAD: &str = "image: map.pgm\nresolution: 0.1\norigin: [1, 2, 0]\n";

    #[test]
    fn what_is_saved_reads_back_the_same() {
        let grid = grid();
        assert_eq!(read_back("same", &pgm(&grid), &yaml(&grid, "map.pgm")).unwrap(), grid);
    }

    #[test]
    fn modes_thresholds_and_negation_are_those_of_map_server() {
        let image = b"P5 # by hand\n4 1\n255\n\x00\x80\xe6\xff";
        let cells =
            |name, text: &str| read_back(name, image, &format!("{HEAD}{text}")).unwrap().cells;
        assert_eq!(cells("trinary", ""), [100, -1, 0, 0]);
        assert_eq!(cells("negate", "negate: 1\n"), [0, -1, 100, 100]);
        assert_eq!(cells("scale", "mode: scale\nfree_thresh: 0.05\n"), [100, 74, 9, 0]);
        assert_eq!(cells("raw", "mode: raw\n"), [0, -1, -1, -1]);
        assert_eq!(cells("thresholds", "occupied_thresh: 0.4\n"), [100, 100, 0, 0]);
    }

    #[test]
    fn what_cannot_be_used_is_told_with_file_and_key() {
        let image = b"P5\n1 1\n255\n\x00";
        let error = |name, image: &[u8], text: &str| read_back(name, image, text).unwrap_err();
        let turned = HEAD.replace("2, 0]", "2, 0.5]");
        for (text, parts) in [
            (turned.as_str(), ["map.yaml: origin", "0.5 rad"]),
            ("image: map.pgm\n", ["map.yaml: ", "resolution"]),
            ("image: [\n", ["map.yaml: ", ""]),
            (&HEAD.replace("0.1", "0"), ["map.yaml: resolution is 0", "above 0"]),
            (&format!("{HEAD}mode: other\n"), ["map.yaml: ", "other"]),
            (&format!("{HEAD}negate: 7\n"), ["map.yaml: negate is 7", "0 or 1"]),
            (&HEAD.replace("map.pgm", "none.pgm"), ["cannot read ", "none.pgm"]),
        ] {
            let error = error("text", image, text);
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
        for image in [&b"P2\n1 1\n255\n0"[..], b"P5\n1 x", b"P5\n0 1\n255\n", b"P5\n2 2\n255\n\x00"]
        {
            assert!(error("image", image, HEAD).contains("map.pgm: it"), "{image:?}");
        }
    }
}
