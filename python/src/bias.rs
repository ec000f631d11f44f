//! Multiplicative and additive bias of catalogues.

use std::path::{Path, PathBuf};

use numpy::PyReadonlyArray1;
use pyo3::exceptions::{PyFileNotFoundError, PyOSError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use shearq_bias::Design;
use shearq_catalogue::columns::{Names, Shapes};
use shearq_catalogue::expression::{Expression, ExpressionError};
use shearq_catalogue::recognition::read_presets;
use shearq_catalogue::request::{
    Binning, Edges, Input, MAX_AXES, MAX_BINS, Request, Survey, Units,
};
use shearq_catalogue::select::selection;
use shearq_catalogue::source::Reading;
use shearq_catalogue::truth::{TrueSign, Truth, expand};
use shearq_files::atomic;
use shearq_files::frames::frame;
use shearq_files::frames::polars::Column;
use shearq_files::table::Place;
use shearq_render::figure::Figure;
use shearq_render::table::{Table, TableFormat};
use shearq_results::bias::{BiasFailure, BiasResult, Summed, joined, sum};
use shearq_results::views::bias::{bias_plot, bias_table, compared_table, section};
use shearq_results::views::pages;
use shearq_scoring::TruthSign;

use crate::errors::{chosen, in_python};

pub(crate) fn sign_of(name: &str) -> PyResult<TruthSign> {
    chosen("truth_sign", name, r#""standard" or "challenge""#)
}

pub(crate) fn of_bias(error: BiasFailure) -> PyErr {
    PyValueError::new_err(in_python(&error.to_string()))
}

// Python's callers expect FileNotFoundError of a wrong path, which the readers below report as any fault of a file.
// `FILE[TABLE]` is a table of a file.
fn require(path: &Path) -> PyResult<()> {
    match Place::of(path).path.exists() {
        true => Ok(()),
        false => Err(PyFileNotFoundError::new_err(format!(
            "{}: there is no file of this name",
            path.display()
        ))),
    }
}

// A design without a true shear follows from its absence, so that null is no argument.
fn design_of(name: &str) -> PyResult<Design> {
    const ALL: [Design; 6] = [
        Design::Single,
        Design::Pairs,
        Design::Arms,
        Design::Fields,
        Design::Galaxies,
        Design::Rotated,
    ];
    // The name of version 0.2.
    let name = if name == "arms" { "shears" } else { name };
    let found = ALL.into_iter().find(|design| design.name() == name);
    found.ok_or_else(|| {
        let names = ALL.map(Design::name).join(", ");
        PyValueError::new_err(format!("design: found {name:?}; expected one of {names}"))
    })
}

pub(crate) fn shapes_of(name: &str) -> PyResult<Shapes> {
    match name {
        "shear" => Ok(Shapes::Shear),
        "distortion" => Ok(Shapes::Converted),
        "responsivity" => Ok(Shapes::Responsivity),
        _ => Err(PyValueError::new_err(format!(
            "ellipticity: found {name:?}; expected 'shear', 'distortion' or 'responsivity'"
        ))),
    }
}

// Frames of pandas and astropy arrive as columns of float64, of integers beyond 2⁵³ or of text, because those are the types that
// `bias` reads: other types and masks are converted in _bias.py, where each package's rules are known.
fn table_of(
    name: &str,
    columns: Vec<(String, Bound<'_, PyAny>)>,
    unread: Vec<(String, String)>,
) -> PyResult<Input> {
    let columns = columns.iter().map(|(label, values)| {
        if let Ok(reals) = values.extract::<PyReadonlyArray1<'_, f64>>() {
            return Ok(Column::new(label.as_str().into(), reals.as_slice()?));
        }
        if let Ok(integers) = values.extract::<PyReadonlyArray1<'_, i64>>() {
            return Ok(Column::new(label.as_str().into(), integers.as_slice()?));
        }
        if let Ok(integers) = values.extract::<PyReadonlyArray1<'_, u64>>() {
            return Ok(Column::new(label.as_str().into(), integers.as_slice()?));
        }
        if let Ok(texts) = values.extract::<Vec<String>>() {
            return Ok(Column::new(label.as_str().into(), texts));
        }
        Err(PyTypeError::new_err(format!(
            "{name}: {label}: expected numbers or text"
        )))
    });
    let columns: Vec<Column> = columns.collect::<PyResult<_>>()?;
    let table =
        frame(columns).map_err(|error| PyValueError::new_err(format!("{name}: {error}")))?;
    Ok(Input {
        name: PathBuf::from(name),
        frame: Some(table),
        unread,
        ..Input::default()
    })
}

// A path, or the name and the columns of a table, with the names of those that are not read and what they have in each row.
#[derive(FromPyObject)]
pub(crate) enum Given<'py> {
    Path(PathBuf),
    Table(
        String,
        Vec<(String, Bound<'py, PyAny>)>,
        Vec<(String, String)>,
    ),
}

impl Given<'_> {
    pub(crate) fn input(self) -> PyResult<Input> {
        match self {
            Given::Table(name, columns, unread) => table_of(&name, columns, unread),
            Given::Path(path) => {
                require(&path)?;
                Ok(path.into())
            }
        }
    }
}

// One shear of all catalogues, one of each by its name, or a file of true shears.
#[derive(FromPyObject)]
pub(crate) enum GivenTruth {
    Constant((f64, f64)),
    Catalogues(Vec<(String, f64, f64)>),
    File(PathBuf),
}

/// Sums of catalogues, from which the bias follows.
#[pyclass(frozen, module = "shearq._shearq")]
pub(crate) struct BiasSums {
    summed: Summed,
}

#[pymethods]
impl BiasSums {
    /// Sums that `to_json` returned.
    #[staticmethod]
    fn from_json(text: &str) -> PyResult<Self> {
        let summed: Summed = serde_json::from_str(text)
            .map_err(|error| PyValueError::new_err(format!("sums: {error}")))?;
        let summed = summed.checked().map_err(of_bias)?;
        Ok(BiasSums { summed })
    }

    /// The sums as JSON, to store or to send to another process.
    fn to_json(&self) -> PyResult<String> {
        serde_json::to_string(&self.summed)
            .map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// The sums of these catalogues and of others, in this order.
    fn append(&self, others: Vec<PyRef<'_, BiasSums>>) -> PyResult<Self> {
        let others = others.iter().map(|own| own.summed.clone());
        let parts = std::iter::once(self.summed.clone()).chain(others);
        let all = joined(parts.map(Ok), Summed::append).map_err(of_bias)?;
        let summed = all.unwrap_or_else(|| self.summed.clone());
        Ok(BiasSums { summed })
    }

    /// The columns that are used, by role.
    fn columns(&self) -> Vec<(String, String)> {
        self.summed.columns().collect()
    }

    /// Rows with a flag, and the axes of the ellipticities if the catalogues state them.
    fn flagged_and_frame(&self) -> (u64, Option<String>) {
        let about = self.summed.about();
        (about.total().flagged, about.frame.clone())
    }

    /// The table of estimates as JSON, and as text; with `against`, of both and their difference.
    fn result(
        &self,
        py: Python<'_>,
        against: Option<PyRef<'_, BiasSums>>,
    ) -> PyResult<(String, String)> {
        let against = against.map(|own| own.summed.clone());
        // Without the interpreter, so that other threads of Python go on during the jackknife.
        py.detach(|| {
            let result = self.summed.result()?;
            let table = self.table(&result, against.as_ref())?;
            // The table's own JSON, so that Python and the command line have the same keys.
            let mut json = table.json();
            // The label of an axis.
            json["binned"] = result.about.cells.names().into();
            Ok((json.to_string(), table.narrow().render(TableFormat::Table)))
        })
        .map_err(of_bias)
    }

    /// Writes the estimates as the command line does: a plot (.pdf, .png, .svg), a page (.html) with its `origin`, or a table (.csv, .md,
    /// .tex, .txt).
    fn save(
        &self,
        py: Python<'_>,
        path: PathBuf,
        against: Option<PyRef<'_, BiasSums>>,
        origin: Vec<(String, String)>,
    ) -> PyResult<()> {
        let against = against.map(|own| own.summed.clone());
        let result = py.detach(|| self.summed.result()).map_err(of_bias)?;
        let table = self.table(&result, against.as_ref()).map_err(of_bias)?;
        let failed = |error: &dyn std::fmt::Display| PyOSError::new_err(error.to_string());
        let ending = path.extension().unwrap_or_default().to_string_lossy();
        let format = match ending.to_ascii_lowercase().as_str() {
            "pdf" | "png" | "svg" => {
                return bias_plot(&result)
                    .save(&path)
                    .map_err(|error| failed(&error));
            }
            "html" | "htm" => {
                let section = section(&result, table).map_err(|error| failed(&error))?;
                return pages::save(&path, "Shear bias", vec![section], origin)
                    .map_err(|error| failed(&error));
            }
            "csv" => TableFormat::Csv,
            "md" => TableFormat::Markdown,
            "tex" => TableFormat::Latex,
            "txt" => TableFormat::Table,
            _ => {
                return Err(PyValueError::new_err(format!(
                    "path: found {:?}; expected a name that ends in .json, .html, .pdf, .png, .svg, .csv, .md, .tex or .txt",
                    path.display().to_string()
                )));
            }
        };
        atomic::write(&path, table.render(format).as_bytes()).map_err(|error| failed(&error))
    }
}

impl BiasSums {
    fn table(&self, result: &BiasResult, against: Option<&Summed>) -> Result<Table, BiasFailure> {
        let mut table = match against {
            None => bias_table(result),
            Some(other) => {
                let difference = self.summed.difference(other)?;
                compared_table(result, &other.result()?, &difference)
            }
        };
        for note in &mut table.notes {
            *note = in_python(note);
        }
        Ok(table)
    }
}

pub(crate) fn names_of(columns: &[String], preset: &[PathBuf]) -> PyResult<Names> {
    let mut names = Names::default();
    for text in columns {
        names
            .add(text)
            .map_err(|fault| PyValueError::new_err(in_python(&fault.to_string())))?;
    }
    for path in preset {
        require(path)?;
        names.add_presets(read_presets(path).map_err(|error| of_bias(error.into()))?);
    }
    Ok(names)
}

/// The columns that `bias` reads of a table with columns of these names; all of them if the arguments have a fault, which `bias`
/// reports.
#[pyfunction]
pub(crate) fn needed_columns(
    names: Vec<String>,
    columns: Vec<String>,
    preset: Vec<PathBuf>,
    bins: Vec<String>,
    condition: Option<&str>,
    weight: Option<&str>,
    units: Option<String>,
) -> PyResult<Vec<String>> {
    let parse = |of: &String| {
        let of = Expression::parse(of).ok()?;
        Some(Binning {
            of,
            edges: Edges::Values,
        })
    };
    let bins: Option<Vec<Binning>> = bins.iter().map(parse).collect();
    let (Some(bins), Ok(selection)) = (bins, selection(condition, weight)) else {
        return Ok(names);
    };
    let request = Request {
        names: names_of(&columns, &preset)?,
        bins,
        selection,
        units: units_of(units),
        ..Request::default()
    };
    let reading = Reading {
        request: &request,
        truth: Truth::Columns,
        flip_g2: false,
    };
    let found = shearq_catalogue::source::needed_columns(&names, &reading);
    Ok(found.map_or(names, |found| found.into_iter().collect()))
}

fn units_of(name: Option<String>) -> Units {
    match name.as_deref() {
        None => Units::Recognised,
        Some("rows") => Units::Rows,
        Some("catalogues") => Units::Catalogues,
        Some(column) => Units::Column(column.to_owned()),
    }
}

/// Sums catalogues.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "the options of the command")]
pub(crate) fn bias_sums(
    py: Python<'_>,
    catalogues: Vec<Given<'_>>,
    columns: Vec<String>,
    preset: Vec<PathBuf>,
    truth: Option<GivenTruth>,
    ellipticity: Option<&str>,
    truth_sign: Option<&str>,
    bins: Vec<(String, Option<usize>, Vec<f64>)>,
    like: Option<Given<'_>>,
    tomography: Option<String>,
    condition: Option<&str>,
    unsheared: Vec<String>,
    weight: Option<&str>,
    design: Option<&str>,
    units: Option<String>,
    paired: bool,
    drop_missing: bool,
    step: f64,
) -> PyResult<BiasSums> {
    let value = |argument: &str| {
        let argument = argument.to_owned();
        move |fault: ExpressionError| PyValueError::new_err(format!("{argument}: {fault}"))
    };
    let names = names_of(&columns, &preset)?;
    if bins.len() > MAX_AXES {
        return Err(PyValueError::new_err(format!(
            "bins: found {} quantities; expected at most {MAX_AXES}",
            bins.len()
        )));
    }
    let bins = bins.into_iter().map(|(of, count, edges)| {
        let of = Expression::parse(&of).map_err(value("bins"))?;
        let edges = match count {
            Some(count) => Edges::equal(count),
            None if edges.is_empty() => Some(Edges::Values),
            None => Edges::given(edges),
        };
        let edges = edges.ok_or_else(|| {
            PyValueError::new_err(format!(
                "bins: expected 2 to {MAX_BINS} bins, or increasing edges"
            ))
        })?;
        Ok(Binning { of, edges })
    });
    let bins = bins.collect::<PyResult<Vec<_>>>()?;
    let like = like.map(|given| -> PyResult<Survey> {
        Ok(Survey {
            catalogue: given.input()?,
            tomography,
        })
    });
    let like = like.transpose()?;
    let specified = truth_sign.map(sign_of).transpose()?;
    let mut sign = TrueSign::or_standard(specified);
    let truth = match truth {
        None => Truth::Columns,
        Some(GivenTruth::Constant((g1, g2))) => Truth::Constant([g1, g2]),
        Some(GivenTruth::Catalogues(all)) => Truth::Catalogues(
            all.into_iter()
                .map(|(name, g1, g2)| (name, [g1, g2]))
                .collect(),
        ),
        Some(GivenTruth::File(path)) => {
            require(&path)?;
            let (truth, own) =
                Truth::read(&path, specified).map_err(|error| of_bias(error.into()))?;
            sign = own;
            truth
        }
    };
    // Paths one by one, because a folder may lie between tables, and catalogues pair by their order.
    let (mut inputs, mut truth, mut without_catalogue) = (Vec::new(), truth, Vec::new());
    for given in catalogues {
        match given {
            Given::Table(name, columns, unread) => {
                inputs.push(table_of(&name, columns, unread)?);
            }
            Given::Path(path) => {
                require(&path)?;
                let found = expand(&[path], truth).map_err(|error| of_bias(error.into()))?;
                inputs.extend(found.catalogues);
                truth = found.truth;
                without_catalogue.extend(found.without_catalogue);
            }
        }
    }
    let request = Request {
        catalogues: inputs,
        names,
        truth,
        shapes: ellipticity.map(shapes_of).transpose()?,
        sign,
        bins,
        like,
        paired,
        selection: selection(condition, weight)
            .map_err(|fault| PyValueError::new_err(fault.to_string()))?,
        unsheared,
        design: design.map(design_of).transpose()?,
        units: units_of(units),
        drop_missing,
        step: Some(step),
        placed: None,
        without_catalogue,
    };
    if let Some(name) = request.unused_unsheared() {
        return Err(PyValueError::new_err(format!(
            "unsheared: `{name}` is not used; expected a column of where or bins"
        )));
    }
    // Shards are of files of the command line; workers in Python sum catalogues of their own.
    let summed = py.detach(|| sum(&request, &|_| true)).map_err(of_bias)?;
    Ok(BiasSums { summed })
}
