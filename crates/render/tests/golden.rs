//! One SVG file for each kind of plot, compared exactly.
//!
//! To accept changed plots, run the test with `ACCEPT_PLOTS=1`. Look at each file before you commit it.
#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure")]

use std::path::Path;

use ndarray::Array2;
use shearq_render::figure::{
    Band, ColourMap, Figure, ImageGrid, ImagePanel, ImageRow, LinePlot, PanelGrid, PictureFormat,
    Series, Style,
};

fn compare(name: &str, figure: &impl Figure) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/golden/{name}.svg"));
    let found = figure.render(PictureFormat::Svg).unwrap();
    if std::env::var_os("ACCEPT_PLOTS").is_some() {
        std::fs::write(&path, &found).unwrap();
    }
    let expected = std::fs::read(&path).unwrap_or_default();
    assert!(
        found == expected,
        "{} differs from the plot. If the change is intended, try: ACCEPT_PLOTS=1 cargo test -p shearq-render --test golden",
        path.display()
    );
}

fn line(title: &str) -> LinePlot {
    let x = vec![100.0, 200.0, 400.0, 800.0];
    LinePlot {
        title: title.into(),
        x_label: "ℓ".into(),
        y_label: "ℓ²C_ℓ/2π".into(),
        x_log: true,
        y_log: true,
        series: vec![
            Series::new(
                "true",
                x.clone(),
                vec![1e-5, 2e-5, 3e-5, 5e-5],
                Style::Line,
                0,
            ),
            Series::new("noise", x.clone(), vec![1e-6; 4], Style::Dashed, 1),
            Series::new(
                "measured",
                x,
                vec![1.2e-5, 1.9e-5, 3.2e-5, 4.9e-5],
                Style::Points,
                2,
            )
            .with_errors(vec![2e-6; 4]),
        ],
        ..LinePlot::default()
    }
}

#[test]
fn a_line_plot_and_panels_that_share_labels_and_legend() {
    compare("line", &line("Shear power"));
    let panels = PanelGrid {
        title: "Shear power spectra".into(),
        columns: 2,
        plots: ["set 2", "set 5", "set 8"].map(line).into(),
    };
    compare("panels", &panels);
}

#[test]
fn a_requirement_is_a_band() {
    let points = |label: &str, aside: f64, colour| {
        let x = vec![1.0 + aside, 2.0 + aside, 3.0 + aside];
        Series::new(label, x, vec![2e-3, 1e-3, -3e-3], Style::Points, colour)
            .with_errors(vec![1e-3; 3])
    };
    let plot = LinePlot {
        x_label: "set".into(),
        x_whole: true,
        y_label: "m".into(),
        bands: vec![Band {
            label: "requirement".into(),
            low: -2e-3,
            high: 2e-3,
        }],
        series: vec![points("m1", -0.05, 0), points("m2", 0.05, 1)],
        ..LinePlot::default()
    };
    compare("band", &plot);
}

#[test]
fn long_names_stand_below_each_other() {
    let names = [
        "23/raw/star",
        "48/linear/star",
        "a rather long name of a configuration",
    ];
    let (x, y) = (vec![0.0, 1.0, 2.0], vec![4.0, 3.0, 2.0]);
    let series = Series::new("", x, y, Style::Points, 0);
    let plot = LinePlot {
        y_label: "Q".into(),
        x_names: names.map(String::from).into(),
        series: vec![series.with_errors(vec![0.5; 3])],
        ..LinePlot::default()
    };
    compare("names", &plot);
}

#[test]
fn images_in_a_grid() {
    let panel = |title: &str, map| ImagePanel {
        title: title.into(),
        image: Array2::from_shape_fn((4, 4), |(y, x)| (x + 4 * y) as f64),
        map,
        ..ImagePanel::default()
    };
    let row = ImageRow {
        label: "S/N 20".into(),
        panels: vec![
            panel("residual", ColourMap::Diverging),
            panel("deconvolved", ColourMap::Viridis),
        ],
    };
    let images = ImageGrid {
        title: "Steps of one galaxy".into(),
        rows: vec![row],
    };
    compare("images", &images);
}
