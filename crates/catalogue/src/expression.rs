//! The language of `--where`, `--weight` and `--bins`: formulas and conditions of columns.

use std::borrow::Cow;
use std::path::Path;

use shearq_files::frames::polars::DataFrame;
use shearq_files::{FileError, MAX_EXACT_INTEGER, table};
use thiserror::Error;

#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ExpressionError {
    #[error("cannot read the expression `{text}` (found {found}, expected {expected})")]
    Syntax {
        text: String,
        found: String,
        expected: &'static str,
    },
    #[error(
        "`{0}`: a step is a weight of galaxies, no number or condition (expected step() alone or beside `and` in --where, for catalogues of linear configurations)"
    )]
    Step(String),
}

/// What to try where [`Expression::check_angles`] refuses.
pub const RADIANS: &str = "radians(ANGLE) for an angle in degrees";

/// A formula such as `flux/flux_error`, or a condition such as `snr > 10 and band == 'r'`.
#[derive(Debug, Clone)]
pub struct Expression {
    text: String,
    operands: Vec<Operand>,
    root: Node,
    sharp: bool,
    // What `cos` and `sin` are of.
    angles: Vec<Node>,
}

/// What an expression reads in each row: the number in a column, or what the text in it is compared with.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Operand {
    pub column: String,
    pub texts: Option<Texts>,
    /// Bits of which the operand has those that the number has, too: a float would lose the low bits of 64.
    pub mask: Option<i64>,
    /// What the integers of a column are compared with: floats merge those above 2⁵³, such as identifiers of Rubin.
    pub integers: Option<Integers>,
}

/// What the integers of a column are compared with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Integers {
    /// The comparison, such as `<`, and an integer. The operand is 1 where it holds, else 0.
    Compared(&'static str, i128),
    /// Integers in ascending order. The operand is the place of the own one among them, from 1 on, and 0 of another one.
    List(Vec<i128>),
}

impl Integers {
    fn value(&self, own: i128) -> f64 {
        match self {
            Integers::Compared(token, other) => truth(match *token {
                "<=" => own <= *other,
                ">=" => own >= *other,
                "==" => own == *other,
                "!=" => own != *other,
                "<" => own < *other,
                _ => own > *other,
            }),
            Integers::List(all) => {
                let found = all.binary_search(&own);
                found.map_or(0.0, |place| (place + 1) as f64)
            }
        }
    }
}

/// What the texts of a column are compared with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Texts {
    /// A text in which `*` stands for any characters. The operand is 1 where it fits, else 0.
    Pattern(String),
    /// Texts in ascending order. The operand is the place of the own text among them, from 1 on, and 0 of another text.
    List(Vec<String>),
}

impl Texts {
    pub fn value(&self, text: &str) -> f64 {
        match self {
            Texts::Pattern(pattern) => truth(fits(pattern, text)),
            Texts::List(all) => {
                let found = all.binary_search_by(|own| own.as_str().cmp(text));
                found.map_or(0.0, |place| (place + 1) as f64)
            }
        }
    }
}

impl Operand {
    fn of_column(column: &str) -> Self {
        Operand {
            column: column.to_owned(),
            ..Operand::default()
        }
    }

    // Whether it is the number of the column itself.
    fn is_plain(&self) -> bool {
        self.texts.is_none() && self.mask.is_none() && self.integers.is_none()
    }

    /// The value where the column has a number.
    pub fn of_number(&self, number: f64) -> f64 {
        match (&self.integers, self.mask) {
            (Some(_), _) if number.is_nan() => f64::NAN,
            // A number between two integers is none of them.
            (Some(Integers::List(_)), _) if number.fract() != 0.0 => 0.0,
            // Those of 2⁵³ and more, with which it is compared, have no fraction.
            (Some(integers), _) => integers.value(number.floor() as i128),
            (None, mask) => mask.map_or(number, |mask| common_bits(number, mask as f64)),
        }
    }

    /// The values where the column has these numbers.
    pub fn of_numbers<'v>(&self, numbers: Cow<'v, [f64]>) -> Cow<'v, [f64]> {
        match self.mask.is_some() || self.integers.is_some() {
            false => numbers,
            true => Cow::Owned(numbers.iter().map(|own| self.of_number(*own)).collect()),
        }
    }
}

/// A smooth step of a weight along a column, `step(snr, 10, 1.5)`: 1/2 at the threshold, and 0 and 1 at the half width
/// from it.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    pub column: String,
    pub threshold: f64,
    pub half_width: Option<f64>,
    /// `1 - step(…)`, which keeps the galaxies below the threshold.
    pub falls: bool,
}

/// A text of `--where`: conditions on rows and steps, joined by `and`.
#[derive(Debug, Clone)]
pub struct Condition {
    pub text: String,
    /// The parts without a step: a row counts if they are not zero.
    pub rows: Option<Expression>,
    pub steps: Vec<Step>,
}

type Function = fn(f64) -> f64;
type Operator = fn(f64, f64) -> f64;

#[derive(Debug, Clone)]
enum Node {
    Number(f64),
    /// One that floats do not contain.
    Integer(i128),
    Operand(usize),
    Unary(Function, Box<Node>),
    Binary(&'static Binary, Box<Node>, Box<Node>),
    Step(Step),
}

type Binary = (&'static str, Operator);

const FUNCTIONS: [(&str, Function); 9] = [
    ("abs", f64::abs),
    ("sqrt", f64::sqrt),
    ("exp", f64::exp),
    ("log", f64::ln),
    ("log10", f64::log10),
    ("cos", f64::cos),
    ("sin", f64::sin),
    ("radians", f64::to_radians),
    ("not", NOT),
];

const NOT: Function = |a| compared(a, a, a == 0.0);
const POWER: Binary = ("^", f64::powf);

// From the loosest to the tightest. Within a level the left one is applied first.
const OPERATORS: [&[Binary]; 6] = [
    &[("or", |a, b| {
        let certain = [a, b].iter().any(|own| *own != 0.0 && !own.is_nan());
        if certain { 1.0 } else { compared(a, b, false) }
    })],
    &[("and", |a, b| {
        let certain = a == 0.0 || b == 0.0;
        if certain { 0.0 } else { compared(a, b, true) }
    })],
    // Longer operators first.
    &[
        ("<=", |a, b| compared(a, b, a <= b)),
        (">=", |a, b| compared(a, b, a >= b)),
        ("==", |a, b| compared(a, b, a == b)),
        ("!=", |a, b| compared(a, b, a != b)),
        ("<", |a, b| compared(a, b, a < b)),
        (">", |a, b| compared(a, b, a > b)),
    ],
    &[("&", common_bits)],
    &[("+", |a, b| a + b), ("-", |a, b| a - b)],
    &[("*", |a, b| a * b), ("/", |a, b| a / b)],
];

// Index in `OPERATORS`.
const COMPARISONS: usize = 2;

fn truth(of: bool) -> f64 {
    f64::from(u8::from(of))
}

// The bits that two whole numbers have in common, as numpy's `&`. NaN of numbers that are not whole, or whose bits are lost.
fn common_bits(a: f64, b: f64) -> f64 {
    let is_whole = |own: f64| own.fract() == 0.0 && own.abs() < MAX_EXACT_INTEGER;
    match is_whole(a) && is_whole(b) {
        true => (a as i64 & b as i64) as f64,
        false => f64::NAN,
    }
}

// NaN with a missing number: a row that neither holds nor fails a condition has to be noticed.
fn compared(a: f64, b: f64, holds: bool) -> f64 {
    if a.is_nan() || b.is_nan() {
        return f64::NAN;
    }
    truth(holds)
}

// Largest angle in radians: 4φ of an angle up to 2π. Position angles in degrees exceed it, and gave m = −0.99 without a word.
const MAX_ANGLE: f64 = 8.0 * std::f64::consts::PI;
// Rows in which angles are looked for. Chosen by hand.
const ANGLE_ROWS: usize = 4096;

// The parser calls itself for each bracket: 10⁴ of them would exhaust the stack.
const DEEPEST: usize = 100;

impl Expression {
    /// Parses an expression: numbers, columns, `+ - * / ^`, `&` (the bits that whole numbers have in common), comparisons of
    /// numbers, `==` and `!=` of a column with a text in quotation marks, `not`, `and`, `or`, and `abs`, `sqrt`, `exp`, `log`,
    /// `log10`, `cos`, `sin` (of radians), `radians` (of degrees) of an expression in brackets. A name with other characters than letters,
    /// digits, `_` and `.` stands between backticks.
    pub fn parse(text: &str) -> Result<Self, ExpressionError> {
        let condition = Condition::parse(text)?;
        match condition.rows {
            Some(expression) if condition.steps.is_empty() => Ok(expression),
            _ => Err(ExpressionError::Step(condition.text)),
        }
    }

    /// The place of the text of a column among `texts`, which are in ascending order.
    pub fn of_texts(column: &str, texts: Vec<String>) -> Self {
        Expression {
            text: column.to_owned(),
            operands: vec![Operand {
                texts: Some(Texts::List(texts)),
                ..Operand::of_column(column)
            }],
            root: Node::Operand(0),
            sharp: true,
            angles: Vec::new(),
        }
    }

    /// The place of the integer of a column among `integers`, which are in ascending order.
    pub fn of_integers(column: &str, integers: Vec<i128>) -> Self {
        let mut own = Expression::of_texts(column, Vec::new());
        own.operands = vec![Operand {
            integers: Some(Integers::List(integers)),
            ..Operand::of_column(column)
        }];
        own
    }

    /// Whether the expression is a number, without a column.
    pub fn is_number(&self) -> bool {
        self.operands.is_empty()
    }

    /// Whether the expression falls with a column through zero, whatever small positive numbers the other columns have: those may be
    /// divisors and angles.
    pub fn falls_with(&self, column: &str) -> bool {
        [0.1, 0.3, 0.6].iter().all(|other| {
            let at = |x: f64| {
                self.value(&|k| {
                    if self.operands[k].column == column {
                        x
                    } else {
                        *other
                    }
                })
            };
            at(0.05) < at(-0.05)
        })
    }

    /// The columns of whose numbers the expression needs more digits than floats of large integers have: all but those that are compared
    /// with a smaller number, or are the expression itself.
    pub fn exact_columns(&self) -> Vec<&str> {
        let mut places = Vec::new();
        if self.column().is_none() {
            self.root.exact(&mut places);
        }
        let operands = places.iter().map(|place| &self.operands[*place]);
        let plain = operands.filter(|own| own.is_plain());
        plain.map(|own| own.column.as_str()).collect()
    }

    /// The column, if the expression is nothing else.
    pub fn column(&self) -> Option<&str> {
        match (&self.root, &self.operands[..]) {
            (Node::Operand(0), [own]) if own.is_plain() => Some(&own.column),
            _ => None,
        }
    }

    /// Whether the expression has derivatives of all orders where its functions are defined: no comparison and no `abs`.
    pub fn is_smooth(&self) -> bool {
        !self.sharp
    }

    pub fn text(&self) -> &str {
        &self.text
    }

    /// What is read in each row, each once.
    pub fn operands(&self) -> &[Operand] {
        &self.operands
    }

    pub fn columns(&self) -> impl Iterator<Item = &str> + Clone {
        self.operands.iter().map(|operand| operand.column.as_str())
    }

    /// Refuses `cos` and `sin` of what can only be degrees; `value` gives the number of an operand in a row,
    /// by the places of both.
    ///
    /// # Errors
    /// The message, beside which [`RADIANS`] is the hint.
    pub fn check_angles(
        &self,
        rows: usize,
        value: impl Fn(usize, usize) -> f64,
    ) -> Result<(), String> {
        let sampled = (0..rows).step_by(rows.div_ceil(ANGLE_ROWS).max(1));
        let of_row = |at: usize| {
            let angles = self.angles.iter();
            let moduli = angles.map(|own| own.value(&|k| value(at, k)).abs());
            // NaN is smaller than any number.
            moduli.fold(0.0, f64::max)
        };
        let largest = sampled.map(of_row).fold(0.0, f64::max);
        match largest > MAX_ANGLE {
            false => Ok(()),
            true => Err(format!(
                "`{}` has angles up to {largest:.1} (expected radians, below 8π)",
                self.text
            )),
        }
    }

    /// The value; `value` gives the number of an operand by its place in [`Expression::operands`].
    pub fn value(&self, value: &impl Fn(usize) -> f64) -> f64 {
        self.root.value(value)
    }

    /// Whether a row for which the value is not zero counts: an infinite value is that of a division by zero. `None` if a
    /// number is missing.
    pub fn holds(&self, value: &impl Fn(usize) -> f64) -> Option<bool> {
        let value = self.value(value);
        (!value.is_nan()).then_some(value.is_finite() && value != 0.0)
    }
}

impl Node {
    fn value(&self, value: &impl Fn(usize) -> f64) -> f64 {
        match self {
            Node::Number(number) => *number,
            Node::Integer(integer) => *integer as f64,
            Node::Operand(place) => value(*place),
            Node::Unary(function, a) => function(a.value(value)),
            Node::Binary((_, operator), a, b) => operator(a.value(value), b.value(value)),
            // `Condition::parse` leaves no step in an expression.
            Node::Step(_) => f64::NAN,
        }
    }

    // Operands but those that are compared with a number that floats contain.
    fn exact(&self, places: &mut Vec<usize>) {
        match self {
            Node::Number(_) | Node::Integer(_) | Node::Step(_) => {}
            Node::Operand(place) => places.push(*place),
            Node::Unary(_, a) => a.exact(places),
            Node::Binary(operator, a, b) => {
                let is_comparison = OPERATORS[COMPARISONS].iter().any(|own| own.0 == operator.0);
                match (&**a, &**b) {
                    (Node::Operand(_), Node::Number(number))
                    | (Node::Number(number), Node::Operand(_))
                        if is_comparison && number.abs() < MAX_EXACT_INTEGER => {}
                    (a, b) => {
                        a.exact(places);
                        b.exact(places);
                    }
                }
            }
        }
    }

    fn has_step(&self) -> bool {
        match self {
            Node::Number(_) | Node::Integer(_) | Node::Operand(_) => false,
            Node::Unary(_, a) => a.has_step(),
            Node::Binary(_, a, b) => a.has_step() || b.has_step(),
            Node::Step(_) => true,
        }
    }

    // Takes out the steps that are joined by `and`, and returns the rest.
    fn without_steps(self, steps: &mut Vec<Step>) -> Option<Node> {
        match self {
            Node::Step(step) => {
                steps.push(step);
                None
            }
            Node::Binary(both @ ("and", _), a, b) => {
                match (a.without_steps(steps), b.without_steps(steps)) {
                    (Some(a), Some(b)) => Some(Node::Binary(both, Box::new(a), Box::new(b))),
                    (a, b) => a.or(b),
                }
            }
            Node::Binary(("-", _), one, step)
                if matches!((&*one, &*step), (Node::Number(1.0), Node::Step(_))) =>
            {
                step.without_steps(steps);
                if let Some(step) = steps.last_mut() {
                    step.falls = true;
                }
                None
            }
            other => Some(other),
        }
    }
}

impl Condition {
    /// Parses conditions as [`Expression::parse`] does, and `step(COLUMN, THRESHOLD, HALF_WIDTH)`, `step(COLUMN, THRESHOLD)`
    /// and `1 - step(…)` alone or beside `and`.
    pub fn parse(text: &str) -> Result<Self, ExpressionError> {
        let mut parser = Parser {
            text,
            at: 0,
            depth: 0,
            operands: Vec::new(),
            sharp: false,
            angles: Vec::new(),
        };
        let root = parser.level(0)?;
        if !parser.rest().is_empty() {
            return Err(parser.expected("an operator"));
        }
        let text = text.trim().to_owned();
        let mut steps = Vec::new();
        let root = root.without_steps(&mut steps);
        if root.as_ref().is_some_and(Node::has_step) {
            return Err(ExpressionError::Step(text));
        }
        let rows = root.map(|root| Expression {
            text: text.clone(),
            operands: parser.operands,
            root,
            sharp: parser.sharp,
            angles: parser.angles,
        });
        Ok(Condition { text, rows, steps })
    }
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    depth: usize,
    operands: Vec<Operand>,
    sharp: bool,
    angles: Vec<Node>,
}

impl<'a> Parser<'a> {
    // The rest of the text, from the next character that is not blank.
    fn rest(&mut self) -> &'a str {
        let rest = &self.text[self.at..];
        self.at = self.text.len() - rest.trim_start().len();
        &self.text[self.at..]
    }

    fn expected(&mut self, expected: &'static str) -> ExpressionError {
        let found = match self.rest() {
            "" => "the end".to_owned(),
            rest => format!("`{rest}`"),
        };
        ExpressionError::Syntax {
            text: self.text.to_owned(),
            found,
            expected,
        }
    }

    // Consumes `token`, which must not continue as a word.
    fn take(&mut self, token: &str) -> bool {
        let Some(rest) = self.rest().strip_prefix(token) else {
            return false;
        };
        let word = |c: char| c.is_alphanumeric() || c == '_';
        if token.ends_with(word) && rest.starts_with(word) {
            return false;
        }
        self.at += token.len();
        true
    }

    fn level(&mut self, level: usize) -> Result<Node, ExpressionError> {
        let Some(operators) = OPERATORS.get(level) else {
            return self.signed();
        };
        if level == COMPARISONS && self.negates() {
            self.sharp = true;
            let inner = self.nested(|parser| parser.level(level))?;
            return Ok(Node::Unary(NOT, Box::new(inner)));
        }
        let first = self.operands.len();
        let mut node = self.level(level + 1)?;
        while let Some(operator) = operators.iter().find(|(token, _)| self.take(token)) {
            // The loosest three levels compare, and bits jump.
            self.sharp |= level <= COMPARISONS + 1;
            let right = self.level(level + 1)?;
            node = match operator.0 {
                "&" => self.masked(operator, node, right, first),
                _ if level == COMPARISONS => self.comparison(operator, node, right, first),
                _ => Node::Binary(operator, Box::new(node), Box::new(right)),
            };
            // `5 < snr < 10` would compare a truth with 10, and `snr > 10 & size > 2` the bits of 10.
            if level == COMPARISONS
                && operators
                    .iter()
                    .any(|(token, _)| self.rest().starts_with(token))
            {
                return Err(self.expected("`and` between two comparisons, or brackets"));
            }
        }
        if level == COMPARISONS && self.rest().starts_with('=') {
            return Err(self.expected("`==` to compare"));
        }
        Ok(node)
    }

    // Consumes `not` before a condition. Before a bracket it is a function, and before an operator the name of a column.
    fn negates(&mut self) -> bool {
        let before = self.at;
        let is_operand = |c: char| c.is_alphanumeric() || "_.`".contains(c);
        let negates = self.take("not") && self.rest().starts_with(is_operand);
        if !negates {
            self.at = before;
        }
        negates
    }

    // The bits that a column and a number have in common, or those of other expressions. Operands from `first` on are those of `a` and `b`.
    fn masked(&mut self, operator: &'static Binary, a: Node, b: Node, first: usize) -> Node {
        let (place, mask) = match (&a, &b) {
            (Node::Operand(place), Node::Number(mask))
            | (Node::Number(mask), Node::Operand(place)) => (*place, *mask),
            _ => return Node::Binary(operator, Box::new(a), Box::new(b)),
        };
        let own = self.operands[place].clone();
        if !own.is_plain() || mask.fract() != 0.0 || mask.abs() >= MAX_EXACT_INTEGER {
            return Node::Binary(operator, Box::new(a), Box::new(b));
        }
        // The number itself is not read for its bits alone.
        self.operands.truncate(place.max(first));
        self.operand(Operand {
            mask: Some(mask as i64),
            ..own
        })
    }

    // Compares a column with an integer that floats do not contain, or other expressions. Operands from `first` on are those of both.
    fn comparison(&mut self, operator: &'static Binary, a: Node, b: Node, first: usize) -> Node {
        let turned = match operator.0 {
            "<=" => ">=",
            ">=" => "<=",
            "<" => ">",
            ">" => "<",
            equal => equal,
        };
        let with_integer = match (&a, &b) {
            (Node::Operand(place), Node::Integer(integer)) => Some((*place, operator.0, *integer)),
            (Node::Integer(integer), Node::Operand(place)) => Some((*place, turned, *integer)),
            _ => None,
        };
        let Some((place, token, integer)) =
            with_integer.filter(|(place, ..)| self.operands[*place].is_plain())
        else {
            return Node::Binary(operator, Box::new(a), Box::new(b));
        };
        let own = self.operands[place].clone();
        // The number itself is not read for a comparison alone.
        self.operands.truncate(place.max(first));
        self.operand(Operand {
            integers: Some(Integers::Compared(token, integer)),
            ..own
        })
    }

    // Compares a column with the text in quotation marks that follows, if one does.
    fn pattern(&mut self, column: &str) -> Option<Result<Node, ExpressionError>> {
        let before = self.at;
        let equal = self.take("==");
        let mark = (equal || self.take("!=")).then(|| self.rest().chars().next());
        let Some(mark @ ('\'' | '"')) = mark.flatten() else {
            self.at = before;
            return None;
        };
        let rest = &self.rest()[1..];
        let Some(length) = rest.find(mark) else {
            return Some(Err(
                self.expected("a text that ends with the same quotation mark")
            ));
        };
        self.at += length + 2;
        self.sharp = true;
        let pattern = Texts::Pattern(rest[..length].to_owned());
        let fits = self.operand(Operand {
            texts: Some(pattern),
            ..Operand::of_column(column)
        });
        Some(Ok(match equal {
            true => fits,
            false => Node::Unary(|fits| 1.0 - fits, Box::new(fits)),
        }))
    }

    fn operand(&mut self, operand: Operand) -> Node {
        let known = self.operands.iter().position(|own| *own == operand);
        Node::Operand(known.unwrap_or_else(|| {
            self.operands.push(operand);
            self.operands.len() - 1
        }))
    }

    fn nested(
        &mut self,
        parse: impl FnOnce(&mut Self) -> Result<Node, ExpressionError>,
    ) -> Result<Node, ExpressionError> {
        if self.depth == DEEPEST {
            return Err(self.expected("fewer brackets"));
        }
        self.depth += 1;
        let node = parse(self)?;
        self.depth -= 1;
        Ok(node)
    }

    fn signed(&mut self) -> Result<Node, ExpressionError> {
        self.nested(|parser| {
            if parser.take("-") {
                return Ok(match parser.signed()? {
                    Node::Integer(integer) => Node::Integer(-integer),
                    other => Node::Unary(|a| -a, Box::new(other)),
                });
            }
            let base = parser.atom()?;
            if parser.take("^") {
                return Ok(Node::Binary(
                    &POWER,
                    Box::new(base),
                    Box::new(parser.signed()?),
                ));
            }
            Ok(base)
        })
    }

    fn atom(&mut self) -> Result<Node, ExpressionError> {
        if self.take("(") {
            return self.closed();
        }
        let rest = self.rest();
        if number_length(rest) > 0 {
            let integer = rest[..number_length(rest)].parse::<i128>().ok();
            let large = integer.filter(|own| is_long(*own));
            return Ok(match (self.number()?, large) {
                (_, Some(integer)) => Node::Integer(integer),
                (number, None) => Node::Number(number),
            });
        }
        if self.take("`") {
            let rest = self.rest();
            let Some(length) = rest.find('`').filter(|length| *length > 0) else {
                return Err(self.expected("a column and a backtick after it"));
            };
            self.at += length + 1;
            return self.compared_column(&rest[..length]);
        }
        let name = self.word();
        if name.is_empty() {
            return Err(self.expected("a number or a column"));
        }
        if name == "step" && self.take("(") {
            return self.step();
        }
        if let Some((_, function)) = FUNCTIONS.iter().find(|(known, _)| *known == name)
            && self.take("(")
        {
            self.sharp |= ["abs", "not"].contains(&name);
            let inner = self.closed()?;
            if ["cos", "sin"].contains(&name) {
                self.angles.push(inner.clone());
            }
            return Ok(Node::Unary(*function, Box::new(inner)));
        }
        self.compared_column(name)
    }

    // A column, or its comparison with a text.
    fn compared_column(&mut self, name: &str) -> Result<Node, ExpressionError> {
        match self.pattern(name) {
            Some(fits) => fits,
            None => Ok(self.operand(Operand::of_column(name))),
        }
    }

    fn word(&mut self) -> &'a str {
        let rest = self.rest();
        let end = rest.find(|c: char| !(c.is_alphanumeric() || c == '_' || c == '.'));
        let word = &rest[..end.unwrap_or(rest.len())];
        self.at += word.len();
        word
    }

    fn number(&mut self) -> Result<f64, ExpressionError> {
        let sign = if self.take("-") { -1.0 } else { 1.0 };
        let rest = self.rest();
        let length = number_length(rest);
        let number = rest[..length].parse::<f64>();
        let number = number.map_err(|_| self.expected("a number"))?;
        self.at += length;
        Ok(sign * number)
    }

    // The step whose bracket was opened.
    fn step(&mut self) -> Result<Node, ExpressionError> {
        let column = self.word().to_owned();
        if column.is_empty() {
            return Err(self.expected("a column"));
        }
        if !self.take(",") {
            return Err(self.expected("a comma and the threshold of the step"));
        }
        let threshold = self.number()?;
        let half_width = self.take(",").then(|| self.number()).transpose()?;
        if !self.take(")") {
            return Err(self.expected("`)`"));
        }
        Ok(Node::Step(Step {
            column,
            threshold,
            half_width,
            falls: false,
        }))
    }

    fn closed(&mut self) -> Result<Node, ExpressionError> {
        let inner = self.level(0)?;
        if self.take(")") {
            Ok(inner)
        } else {
            Err(self.expected("`)`"))
        }
    }
}

/// Whether `text` is `pattern`, in which `*` stands for any characters.
pub fn fits(pattern: &str, text: &str) -> bool {
    let Some((first, rest)) = pattern.split_once('*') else {
        return pattern == text;
    };
    let Some(text) = text.strip_prefix(first) else {
        return false;
    };
    // `*` may stand for any beginning of the remaining text.
    let mut ends = text.char_indices().map(|(at, _)| at).chain([text.len()]);
    ends.any(|at| fits(rest, &text[at..]))
}

// Characters of the number that a text starts with, with its exponent: the longest part that is a number.
fn number_length(text: &str) -> usize {
    // Rust reads `inf` and `nan`, too, which may be names of columns.
    if !text.starts_with(|c: char| c.is_ascii_digit() || c == '.') {
        return 0;
    }
    let ends = |&(at, c): &(usize, char)| match c {
        '+' | '-' => !text[..at].ends_with(['e', 'E']),
        c => !(c.is_ascii_digit() || ".eE".contains(c)),
    };
    let end = text.char_indices().find(ends);
    let mut lengths = (1..=end.map_or(text.len(), |(at, _)| at)).rev();
    lengths
        .find(|length| text[..*length].parse::<f64>().is_ok())
        .unwrap_or(0)
}

/// The values of an operand in each row of a table.
pub fn operand_values<'f>(
    frame: &'f DataFrame,
    operand: &Operand,
    path: &Path,
) -> Result<Cow<'f, [f64]>, FileError> {
    let Operand {
        column,
        texts,
        mask,
        integers,
    } = operand;
    if let Some(integers) = integers {
        let shown = match integers {
            Integers::Compared(token, other) => format!("{column} {token} {other}"),
            Integers::List(_) => column.clone(),
        };
        return of_integers(frame, operand, &shown, |own| integers.value(own), path);
    }
    if let Some(mask) = mask {
        let shown = format!("{column} & {mask}");
        let common = |own: i128| (own & i128::from(*mask)) as f64;
        return of_integers(frame, operand, &shown, common, path);
    }
    let Some(compared) = texts else {
        return table::numbers(frame, column, path);
    };
    let Some(texts) = texts_of(frame, column) else {
        let found = match compared {
            Texts::Pattern(pattern) => format!("a comparison with '{pattern}', expected a number"),
            Texts::List(_) => "numbers, expected texts as in other catalogues".to_owned(),
        };
        let message = format!("column `{column}` contains no texts (found {found})");
        return Err(FileError::new(path, message));
    };
    let values = texts.map(|text| compared.value(text.unwrap_or_default()));
    Ok(Cow::Owned(values.collect()))
}

// A value of each of the integers of a table. Tables of text have floats.
fn of_integers<'f>(
    frame: &'f DataFrame,
    operand: &Operand,
    shown: &str,
    value: impl Fn(i128) -> f64,
    path: &Path,
) -> Result<Cow<'f, [f64]>, FileError> {
    let name = operand.column.as_str();
    if let Some(integers) = integers_of(frame, name) {
        return Ok(integers.map(|own| own.map_or(f64::NAN, &value)).collect());
    }
    let numbers = table::numbers(frame, name, path)?;
    if let Some(large) = numbers.iter().find(|own| own.abs() >= MAX_EXACT_INTEGER) {
        let message = format!(
            "column `{name}` has numbers of 2⁵³ or more, whose low bits are lost (found {large:e} for `{shown}`, expected smaller ones, or integers of a FITS, Parquet or Arrow file)"
        );
        return Err(FileError::new(path, message).hint("such a file, or a column of the low bits"));
    }
    Ok(operand.of_numbers(numbers))
}

/// The integers of a column of 64 bits.
pub fn integers_of<'f>(
    frame: &'f DataFrame,
    name: &str,
) -> Option<Box<dyn Iterator<Item = Option<i128>> + 'f>> {
    let series = frame.column(name).ok()?.as_materialized_series();
    if let Ok(integers) = series.i64() {
        return Some(Box::new(integers.iter().map(|own| own.map(i128::from))));
    }
    let integers = series.u64().ok()?;
    Some(Box::new(integers.iter().map(|own| own.map(i128::from))))
}

/// Whether floats merge an integer with others.
pub fn is_long(integer: i128) -> bool {
    integer.unsigned_abs() >= MAX_EXACT_INTEGER as u128
}

/// Whether a column has integers that floats do not contain.
pub fn has_long_integers(frame: &DataFrame, name: &str) -> bool {
    integers_of(frame, name).is_some_and(|mut all| all.any(|own| own.is_some_and(is_long)))
}

/// Refuses those of the `columns` of an expression that have integers which floats merge.
pub fn refuse_long_integers(
    frame: &DataFrame,
    columns: &[&str],
    expression: &Expression,
    path: &Path,
) -> Result<(), FileError> {
    match columns.iter().find(|name| has_long_integers(frame, name)) {
        None => Ok(()),
        Some(name) => {
            let message = format!(
                "column `{name}` has integers of 2⁵³ or more, which differ by less than their floats (found `{}`, expected smaller ones, or a comparison with an integer)",
                expression.text()
            );
            Err(FileError::new(path, message)
                .hint("a column of smaller integers, such as the differences from the first one"))
        }
    }
}

/// A formula with other names of its columns, where `name` gives one.
pub fn with_names(text: &str, name: impl Fn(&str) -> Option<String>) -> String {
    let is_word = |c: char| c.is_alphanumeric() || c == '_' || c == '.';
    let renamed = |own: &str| {
        let new = name(own)?;
        Some(match new.chars().all(is_word) {
            true => new,
            false => format!("`{new}`"),
        })
    };
    let (mut all, mut rest) = (String::new(), text);
    while let Some(first) = rest.chars().next() {
        let number = number_length(rest);
        let length = match first {
            '\'' | '"' | '`' => rest[1..].find(first).map_or(rest.len(), |end| end + 2),
            _ if number > 0 => number,
            c if is_word(c) => rest.find(|c| !is_word(c)).unwrap_or(rest.len()),
            c => c.len_utf8(),
        };
        let (token, after) = rest.split_at(length);
        let is_function = after.trim_start().starts_with('(');
        let new = match first {
            '`' => renamed(token.trim_matches('`')),
            c if is_word(c) && number == 0 && !is_function => renamed(token),
            _ => None,
        };
        all.push_str(new.as_deref().unwrap_or(token));
        rest = after;
    }
    all
}

pub fn texts_of<'f>(
    frame: &'f DataFrame,
    name: &str,
) -> Option<impl Iterator<Item = Option<&'f str>> + use<'f>> {
    Some(frame.column(name).ok()?.str().ok()?.iter())
}

#[cfg(test)]
mod tests {
    use shearq_files::frames::polars::Column;

    use super::*;

    fn value(text: &str, values: &[f64]) -> f64 {
        Expression::parse(text).unwrap().value(&|k| values[k])
    }

    #[test]
    fn operators_bind_as_usual() {
        assert_eq!(value("1 + 2*3^2 - 4/2", &[]), 17.0);
        assert_eq!(value("-2^2 + (1 - 3)", &[]), -6.0);
        assert_eq!(value("2e-3*10", &[]), 0.02);
        assert_eq!(value("2e-3-1e+2+.5-3.", &[]), 2e-3 - 100.0 + 0.5 - 3.0);
        assert_eq!(value("8 - 2 - 1", &[]), 5.0);
        // Of formulas; of a column, the integers of its table are used.
        assert_eq!(value("flag + 0 & 4 == 0", &[13.0]), 0.0);
        // The number itself is read where something else needs it.
        for (text, columns) in [
            ("flag & 4 == 0", 1),
            ("flag == 3 or 4 & flag", 2),
            ("flag & 4 or flag & 8", 2),
        ] {
            let found = Expression::parse(text).unwrap();
            assert_eq!(found.operands().len(), columns, "{text}");
        }
        assert_eq!(
            value("flag & (3 + 8) == 8 and (flag*1) & 2 == 0", &[12.0]),
            1.0
        );
        for missing in [0.5, f64::NAN, 2f64.powi(53)] {
            assert!(value("flag*1 & 4", &[missing]).is_nan());
        }
        assert!((value("0.3*cos(2*phi)", &[0.5]) - 0.3 * 1f64.cos()).abs() < 1e-16);
        assert_eq!(value("log10(flux_2/err)", &[100.0, 1.0]), 2.0);
        assert_eq!(value("a > 1 and b <= 2 or not(a == a)", &[2.0, 2.0]), 1.0);
        assert_eq!(value("android + stepper", &[7.0, 1.0]), 8.0);
        assert_eq!(value("not a == 1 and not b", &[2.0, 0.0]), 1.0);
        assert_eq!(value("not a + 1 == 3 or notes", &[2.0, 0.0]), 0.0);
        assert_eq!(value("not > 1 and not(not < 1)", &[2.0]), 1.0);
        for (text, missing) in [
            ("a > 1", true),
            ("not(a > 1)", true),
            ("a > 1 and b == 1", true),
            ("a > 1 and b == 2", false),
            ("a > 1 or b == 2", true),
            ("a > 1 or b == 1", false),
        ] {
            assert_eq!(value(text, &[f64::NAN, 1.0]).is_nan(), missing, "{text}");
        }
        assert_eq!(value("`s/n (old)` > 1 and `a` < 3", &[2.0, 2.0]), 1.0);
        let quoted = Expression::parse("`my band` == 'r*'").unwrap();
        assert_eq!(quoted.operands()[0].column, "my band");
        assert!((value("cos(radians(2*pa))", &[45.0])).abs() < 1e-16);
        let held = [-2.0, 0.0, f64::INFINITY, f64::NAN].map(|a| {
            let expression = Expression::parse("a").unwrap();
            expression.holds(&|_| a)
        });
        assert_eq!(held, [Some(true), Some(false), Some(false), None]);
        let twice = Expression::parse("a*a + b").unwrap();
        assert!(twice.columns().eq(["a", "b"]));
    }

    #[test]
    fn long_integers_are_compared_exactly() {
        let large = 37_484_563_299_062_923_i64;
        let all = Column::new("id".into(), [large - 1, large, large + 1, 5]);
        let table = shearq_files::frames::frame(vec![all]).unwrap();
        for (text, expected) in [
            ("id < 37484563299062923", [1.0, 0.0, 0.0, 1.0]),
            ("37484563299062923 <= id", [0.0, 1.0, 1.0, 0.0]),
            ("id != 37484563299062923", [1.0, 0.0, 1.0, 1.0]),
            ("id > -37484563299062923", [1.0; 4]),
        ] {
            let own = Expression::parse(text).unwrap();
            let values = operand_values(&table, &own.operands()[0], Path::new("t")).unwrap();
            let found = [0, 1, 2, 3].map(|at| own.value(&|_| values[at]));
            assert_eq!(found, expected, "{text}");
            refuse_long_integers(&table, &own.exact_columns(), &own, Path::new("t")).unwrap();
        }
        for text in [
            "id == id + 1",
            "id - 37484563299062923 < 100",
            "id < 37484563299062923.5",
            "sqrt(id) > 1",
        ] {
            let own = Expression::parse(text).unwrap();
            let found = refuse_long_integers(&table, &own.exact_columns(), &own, Path::new("t"));
            assert!(found.is_err(), "{text}");
        }
        let own = Expression::parse("id").unwrap();
        refuse_long_integers(&table, &["id"], &own, Path::new("t")).unwrap_err();
        let own = Expression::parse("id > 6").unwrap();
        refuse_long_integers(&table, &own.exact_columns(), &own, Path::new("t")).unwrap();
        // Of floats, the last digits are lost.
        let floats = Column::new("id".into(), [large as f64]);
        let table = shearq_files::frames::frame(vec![floats]).unwrap();
        let own = Expression::parse("id < 37484563299062923").unwrap();
        operand_values(&table, &own.operands()[0], Path::new("t")).unwrap_err();
    }

    #[test]
    fn formulas_get_other_names_and_signs() {
        let upper = |name: &str| (name != "x").then(|| name.to_uppercase());
        let found = with_names("-g_1 + 2e3*sqrt(`a b`)/x == 'g_1'", upper);
        assert_eq!(found, "-G_1 + 2e3*sqrt(`A B`)/x == 'g_1'");
        for (text, negative) in [
            ("-e2", true),
            ("0 - e2", true),
            ("e2*(-1)/0.8", true),
            ("-(e2 - c2)", true),
            ("e2 - c2", false),
            ("e2^2", false),
            ("1 - e2", true),
            ("c2 - e2", true),
            ("-c2 + e2", false),
            ("-0.001 + e2", false),
            ("e2*cos(2*phi)", false),
            ("-e2*sin(2*phi)", true),
            ("-e2/P", true),
            ("e2/P", false),
        ] {
            let own = Expression::parse(text).unwrap();
            assert_eq!(own.falls_with("e2"), negative, "{text}");
        }
    }

    #[test]
    fn angles_in_degrees_are_refused() {
        let check = |text: &str, angles: &[f64]| {
            let expression = Expression::parse(text).unwrap();
            expression.check_angles(angles.len(), |at, _| angles[at])
        };
        let error = check("0.3*sin(2*pa)", &[0.0, f64::NAN, -90.0]).unwrap_err();
        assert!(error.contains("angles up to 180.0"), "{error}");
        check("cos(4*pa)", &[-6.2, 6.2, f64::NAN]).unwrap();
        check("cos(radians(2*pa))", &[180.0, 360.0]).unwrap();
        check("pa > 100", &[180.0]).unwrap();
    }

    #[test]
    fn smooth_expressions_are_known() {
        for (text, smooth) in [
            ("snr^2/(snr^2 + 100)", true),
            ("exp(-size)", true),
            ("abs(snr)", false),
            ("size + (snr > 10)", false),
            ("not(snr)", false),
        ] {
            let expression = Expression::parse(text).unwrap();
            assert_eq!(expression.is_smooth(), smooth, "{text}");
        }
    }

    #[test]
    fn texts_are_compared_with_patterns() {
        let found = Expression::parse("psf == 'a*' or psf != \"b\" and set == 3").unwrap();
        let operand = |column: &str, pattern: Option<&str>| Operand {
            column: column.into(),
            texts: pattern.map(|own| Texts::Pattern(own.to_owned())),
            ..Operand::default()
        };
        let expected = [
            operand("psf", Some("a*")),
            operand("psf", Some("b")),
            operand("set", None),
        ];
        assert_eq!(found.operands(), expected);
        assert_eq!(found.value(&|k| [0.0, 1.0, 3.0][k]), 0.0);
        assert_eq!(found.value(&|k| [0.0, 0.0, 3.0][k]), 1.0);
        let list = Texts::List(["*", "a*", "it's \"b\""].map(str::to_owned).to_vec());
        let values = ["*", "ab", "a*", "it's \"b\""].map(|text| list.value(text));
        assert_eq!(values, [1.0, 0.0, 2.0, 3.0]);
        for (pattern, text, expected) in [
            ("23/*", "23/den/star", true),
            ("*star", "23/den/star", true),
            ("*/den/*", "subm/23/den/func", true),
            ("low", "low", true),
            ("23/*", "subm/23/den/func", false),
            ("low", "lower", false),
            ("*star", "23/den/stars", false),
        ] {
            assert_eq!(fits(pattern, text), expected, "{pattern} {text}");
        }
    }

    #[test]
    fn bits_are_those_of_the_integers_of_a_table() {
        use shearq_files::frames::frame;
        use shearq_files::frames::polars::Column;
        let of = |column: Column, text: &str| {
            let table = frame(vec![column]).unwrap();
            let expression = Expression::parse(text).unwrap();
            let operands = expression.operands().iter();
            let columns: Result<Vec<_>, _> = operands
                .map(|own| operand_values(&table, own, Path::new("t")).map(Cow::into_owned))
                .collect();
            columns.map(|all| expression.value(&|k| all[k][0]))
        };
        let large = (1_i64 << 60) + 5;
        for text in ["a & 4 == 4", "4 & a == 4 and a & 2 == 0", "a & 1"] {
            let signed = Column::new("a".into(), [large]);
            assert_eq!(of(signed, text).unwrap(), 1.0, "{text}");
            let unsigned = Column::new("a".into(), [(1_u64 << 63) + 5]);
            assert_eq!(of(unsigned, text).unwrap(), 1.0, "{text}");
            assert_eq!(of(Column::new("a".into(), [13.0]), text).unwrap(), 1.0);
            let error = of(Column::new("a".into(), [large as f64]), text).unwrap_err();
            assert!(error.to_string().contains("column `a` has numbers of 2⁵³"));
        }
    }

    #[test]
    fn steps_are_separated_from_conditions() {
        let step = |column: &str, threshold, half_width, falls| Step {
            column: column.into(),
            threshold,
            half_width,
            falls,
        };
        let found =
            Condition::parse("step(snr, -10) and x > 2 and 1 - step(size, 3, 0.5)").unwrap();
        let expected = [
            step("snr", -10.0, None, false),
            step("size", 3.0, Some(0.5), true),
        ];
        assert_eq!(found.steps, expected);
        let rows = found.rows.unwrap();
        assert_eq!([1.0, 3.0].map(|x| rows.value(&|_| x)), [0.0, 1.0]);
        assert!(Condition::parse("step(snr, 10)").unwrap().rows.is_none());
        for text in [
            "2*step(snr, 10)",
            "x > 1 or step(snr, 1)",
            "not(step(snr, 1))",
        ] {
            let expected = ExpressionError::Step(text.into());
            assert_eq!(Condition::parse(text).unwrap_err(), expected);
        }
        let text = "step(snr, 10)";
        let expected = ExpressionError::Step(text.into());
        assert_eq!(Expression::parse(text).unwrap_err(), expected);
    }

    #[test]
    fn mistakes_are_reported_with_their_place() {
        for (text, expected) in [
            ("", "found the end, expected a number or a column"),
            ("a +", "found the end"),
            ("(a", "expected `)`"),
            ("a b", "found `b`, expected an operator"),
            ("a ? 2", "found `? 2`"),
            ("a = 2", "found `= 2`, expected `==` to compare"),
            ("5 < a < 10", "found `< 10`, expected `and` between two"),
            ("a > 5 & b > 2", "found `> 2`, expected `and` between two"),
            ("a == 'b", "ends with the same quotation mark"),
            ("`a b > 2", "a column and a backtick after it"),
            ("a + 1 == 'b'", "found `'b'`, expected a number or a column"),
            ("step(snr > 3)", "a comma and the threshold"),
            ("step(snr, x)", "found `x)`, expected a number"),
            (&"(".repeat(10_000), "fewer brackets"),
            (
                &"not a ".replace('a', &"not ".repeat(10_000)),
                "fewer brackets",
            ),
        ] {
            let error = Condition::parse(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
