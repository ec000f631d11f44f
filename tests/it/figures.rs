//! Every kind of figure with data that are empty, constant, not finite or extreme, and the errors.

use ndarray::Array2;
use shearq_render::figure::{
    Band, ColourMap, Figure, FigureError, ImageGrid, ImagePanel, ImageRow, LinePlot, PanelGrid,
    PictureFormat, Series, Stretch, Style,
};

const HARD: [&[f64]; 9] = [
    &[],
    &[0.0],
    &[f64::NAN, f64::INFINITY, f64::NEG_INFINITY],
    &[2.0, 2.0, 2.0],
    &[f64::MAX, f64::MIN, 0.0],
    &[1e-310, 1e-300, 1.0],
    &[1.0, f64::NAN, 3.0],
    &[-1.0, 0.0, 1e-5],
    &[1.0, 1.0 + f64::EPSILON, 1.0],
];

/// Draws in both formats; the results must be what they claim to be.
fn draw(figure: &impl Figure) {
    let svg = String::from_utf8(figure.render(PictureFormat::Svg).expect("SVG")).expect("UTF-8");
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
    assert!(!svg.contains("NaN") && !svg.contains("inf"));
    let png = figure.render(PictureFormat::Png).expect("PNG");
    assert!(png.starts_with(b"\x89PNG"));
}

fn lines(x: &[f64], y: &[f64], log: bool) -> LinePlot {
    let series = [Style::Line, Style::Points, Style::Dashed].map(|style| {
        Series::new("hard", x.to_vec(), y.to_vec(), style, 11)
            .with_errors(y.iter().rev().copied().collect())
    });
    LinePlot {
        x_log: log,
        y_log: log,
        series: series.into(),
        ..LinePlot::default()
    }
}

#[test]
fn curves_names_and_bands_of_any_data_are_drawn() {
    let mut plots = Vec::new();
    for y in HARD {
        let x: Vec<f64> = (0..y.len()).map(|i| i as f64).collect();
        for log in [false, true] {
            plots.push(lines(&x, y, log));
            plots.push(LinePlot {
                x_range: Some((-1.0, 0.5)),
                ..lines(y, y, log)
            });
        }
        let band = |&value: &f64| Band {
            label: "allowed".into(),
            low: value,
            high: 1.0,
        };
        plots.push(LinePlot {
            x_names: (0..y.len()).map(|i| format!("<name {i}>")).collect(),
            bands: y.iter().map(band).collect(),
            ..lines(&x, y, false)
        });
    }
    for (columns, plots) in [(0, vec![]), (6, plots)] {
        draw(&PanelGrid {
            title: "Hard & <difficult>".into(),
            columns,
            plots,
        });
    }
    draw(&LinePlot::default());
}

#[test]
fn images_of_any_data_are_drawn() {
    draw(&ImageGrid::default());
    let rows = HARD.map(|values| {
        let image = Array2::from_shape_vec((1, values.len()), values.to_vec()).expect("one row");
        let panel = |map| ImagePanel {
            image: image.clone(),
            map,
            stretch: Stretch::Asinh,
            ..ImagePanel::default()
        };
        ImageRow {
            label: "hard".into(),
            panels: [ColourMap::Viridis, ColourMap::Diverging].map(panel).into(),
        }
    });
    for row in rows {
        draw(&ImageGrid {
            title: String::new(),
            rows: vec![row, ImageRow::default()],
        });
    }
}

#[test]
fn errors_name_the_place_and_what_was_expected() {
    let plot = lines(&[1.0], &[1.0], false);
    let message = |path: &str| plot.save(path).expect_err("refused").to_string();
    assert!(message("figure").contains("found no extension"));
    // Below a file there can be no folder.
    assert!(message("Cargo.toml/figure.svg").starts_with("Cargo.toml: cannot make the folder"));
    let many = PanelGrid {
        title: String::new(),
        columns: 2,
        plots: vec![plot; 2000],
    };
    let error = many.render(PictureFormat::Svg).expect_err("too large");
    assert!(matches!(error, FigureError::TooLarge { .. }));
}
