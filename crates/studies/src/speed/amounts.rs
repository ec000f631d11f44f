//! Time against the number of galaxies.

use shearq_pipeline::PipelineError;
use shearq_pipeline::engine::Quiet;
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_render::figure::{LinePlot, Series, Style};
use shearq_render::table::{Cell, Heading, Table};
use shearq_simulate::set::SimulationSettings;
use shearq_submissions::Configuration;

use super::{median_seconds, seconds};

/// Amounts of fewer galaxies are timed several times.
const REPEATED: f64 = 1e5;

/// Galaxies per side of small images.
const SMALL_GRID: usize = 32;

/// Time of simulating and measuring in memory against the number of galaxies, up to `most`: in one image, and in images
/// of about a thousand galaxies.
#[derive(Debug)]
pub struct Amounts {
    name: String,
    threads: usize,
    points: Vec<Amount>,
}

/// One point of [`Amounts`].
#[derive(Debug)]
struct Amount {
    /// Galaxies per side of an image.
    grid: usize,
    images: u32,
    seconds: f64,
}

impl Amount {
    fn galaxies(&self) -> f64 {
        (self.grid * self.grid) as f64 * f64::from(self.images)
    }
}

/// Times for [`Amounts`].
///
/// # Errors
/// If the sizes of the configuration are invalid, or if threads cannot be started.
pub fn amounts(
    configuration: &Configuration,
    settings: SimulationSettings,
    threads: usize,
    most: f64,
) -> Result<Amounts, PipelineError> {
    let measurers = measurers(std::slice::from_ref(configuration))?;
    let one = [32, 100, 316].map(|grid| (grid, 1));
    let many = [10, 100, 1000, 10_000].map(|images| (SMALL_GRID, images));
    let mut points = Vec::new();
    for (grid, images) in one.into_iter().chain(many) {
        let mut amount = Amount {
            grid,
            images,
            seconds: 0.0,
        };
        if amount.galaxies() > 1.1 * most {
            continue;
        }
        let set = simulator(2, SimulationSettings { grid, ..settings })?;
        let images: Vec<u32> = (1..=images).collect();
        let run = || {
            run_set(
                &set,
                &images,
                &measurers,
                threads,
                &mut Quiet,
                |_, _| Ok(()),
            )
        };
        amount.seconds = if amount.galaxies() < REPEATED {
            median_seconds(run)?
        } else {
            // Long enough to be stable.
            seconds(run)?
        };
        points.push(amount);
    }
    Ok(Amounts {
        name: configuration.name.clone(),
        threads,
        points,
    })
}

impl Amounts {
    /// One row per point.
    pub fn table(&self) -> Table {
        let row = |amount: &Amount| {
            let galaxies = amount.galaxies();
            vec![
                Cell::number(f64::from(amount.images), 0),
                Cell::number(galaxies / f64::from(amount.images), 0),
                Cell::number(galaxies, 0),
                Cell::number(amount.seconds, 2),
                Cell::number(1e6 * amount.seconds * self.threads as f64 / galaxies, 1),
            ]
        };
        Table {
            title: format!(
                "Simulating and measuring {} in memory, by number",
                self.name
            ),
            headings: vec![
                Heading::new("images", "Images"),
                Heading::new("per_image", "galaxies per image"),
                Heading::new("galaxies", "galaxies"),
                Heading::new("seconds", "seconds"),
                Heading::new("microseconds", "µs per galaxy and thread"),
            ],
            rows: self.points.iter().map(row).collect(),
            notes: vec![format!("{} thread(s).", self.threads)],
        }
    }

    /// The same as a plot.
    pub fn figure(&self) -> LinePlot {
        let series = [("one image", true), ("images of 1,024 galaxies", false)];
        let series = series.into_iter().enumerate().map(|(k, (name, single))| {
            // The smallest image belongs to both.
            let of = |amount: &&Amount| {
                (amount.images == 1) == single || amount.grid == SMALL_GRID && amount.images == 1
            };
            let points: Vec<&Amount> = self.points.iter().filter(of).collect();
            let x = points.iter().map(|amount| amount.galaxies()).collect();
            let y = points.iter().map(|amount| amount.seconds).collect();
            Series::new(name, x, y, Style::Line, k)
        });
        LinePlot {
            title: format!("Time against number of galaxies, {}", self.name),
            x_label: "galaxies".into(),
            y_label: "seconds".into(),
            x_log: true,
            y_log: true,
            series: series.collect(),
            ..LinePlot::default()
        }
    }
}
