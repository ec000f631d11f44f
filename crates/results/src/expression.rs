//! Expressions of columns, such as `flux/flux_error` or `snr > 10 and size < 4`.

/// An expression of columns.
#[derive(Debug, Clone)]
pub struct Expression {
    text: String,
    columns: Vec<String>,
    root: Node,
    /// Whether a comparison, `and`, `or`, `not` or `abs` is used.
    sharp: bool,
}

type Function = fn(f64) -> f64;
type Operator = fn(f64, f64) -> f64;

#[derive(Debug, Clone)]
enum Node {
    Number(f64),
    Column(usize),
    Unary(Function, Box<Node>),
    Binary(Operator, Box<Node>, Box<Node>),
}

/// Functions of one number.
const FUNCTIONS: [(&str, Function); 6] = [
    ("abs", f64::abs),
    ("sqrt", f64::sqrt),
    ("exp", f64::exp),
    ("log", f64::ln),
    ("log10", f64::log10),
    ("not", |a| truth(a == 0.0)),
];

/// Operators from the loosest to the tightest. Within a level the left one is applied first.
const OPERATORS: [&[(&str, Operator)]; 5] = [
    &[("or", |a, b| truth(a != 0.0 || b != 0.0))],
    &[("and", |a, b| truth(a != 0.0 && b != 0.0))],
    // Longer operators first.
    &[
        ("<=", |a, b| compared(a, b, a <= b)),
        (">=", |a, b| compared(a, b, a >= b)),
        ("==", |a, b| compared(a, b, a == b)),
        ("!=", |a, b| compared(a, b, a != b)),
        ("<", |a, b| compared(a, b, a < b)),
        (">", |a, b| compared(a, b, a > b)),
    ],
    &[("+", |a, b| a + b), ("-", |a, b| a - b)],
    &[("*", |a, b| a * b), ("/", |a, b| a / b)],
];

fn truth(of: bool) -> f64 {
    f64::from(u8::from(of))
}

/// A comparison; NaN with a missing number, so that it is noticed.
fn compared(a: f64, b: f64, holds: bool) -> f64 {
    if a.is_nan() || b.is_nan() {
        return f64::NAN;
    }
    truth(holds)
}

/// Deepest nesting.
const DEEPEST: usize = 100;

impl Expression {
    /// Parses an expression: numbers, columns, `+ - * / ^`, comparisons, `and`, `or`, and `abs`, `sqrt`, `exp`, `log`,
    /// `log10`, `not` of an expression in brackets.
    ///
    /// # Errors
    /// What was expected, and where.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut parser = Parser {
            text,
            at: 0,
            depth: 0,
            columns: Vec::new(),
            sharp: false,
        };
        let root = parser.level(0)?;
        if !parser.rest().is_empty() {
            return Err(parser.expected("an operator"));
        }
        Ok(Expression {
            text: text.trim().to_owned(),
            columns: parser.columns,
            root,
            sharp: parser.sharp,
        })
    }

    /// Whether the expression has derivatives of all orders where its functions are defined: no comparison and no `abs`.
    pub fn is_smooth(&self) -> bool {
        !self.sharp
    }

    /// The text that was parsed.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The columns, each once.
    pub fn columns(&self) -> &[String] {
        &self.columns
    }

    /// The value; `value` gives the value of the column of a number in [`Expression::columns`].
    pub fn value(&self, value: &impl Fn(usize) -> f64) -> f64 {
        fn of(node: &Node, value: &impl Fn(usize) -> f64) -> f64 {
            match node {
                Node::Number(number) => *number,
                Node::Column(column) => value(*column),
                Node::Unary(function, a) => function(of(a, value)),
                Node::Binary(operator, a, b) => operator(of(a, value), of(b, value)),
            }
        }
        of(&self.root, value)
    }
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    depth: usize,
    columns: Vec<String>,
    sharp: bool,
}

impl<'a> Parser<'a> {
    /// The rest of the text, from the next character that is not blank.
    fn rest(&mut self) -> &'a str {
        let rest = &self.text[self.at..];
        self.at = self.text.len() - rest.trim_start().len();
        &self.text[self.at..]
    }

    fn expected(&mut self, what: &str) -> String {
        let found = match self.rest() {
            "" => "the end".to_owned(),
            rest => format!("`{rest}`"),
        };
        format!(
            "cannot read the expression `{}` (found {found}, expected {what})",
            self.text
        )
    }

    /// Consumes `token`, which must not continue as a word.
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

    fn level(&mut self, level: usize) -> Result<Node, String> {
        let Some(operators) = OPERATORS.get(level) else {
            return self.signed();
        };
        let mut node = self.level(level + 1)?;
        while let Some((_, operator)) = operators.iter().find(|(token, _)| self.take(token)) {
            // The loosest three levels compare.
            self.sharp |= level < 3;
            let right = self.level(level + 1)?;
            node = Node::Binary(*operator, Box::new(node), Box::new(right));
        }
        Ok(node)
    }

    fn signed(&mut self) -> Result<Node, String> {
        if self.depth == DEEPEST {
            return Err(self.expected("fewer brackets"));
        }
        self.depth += 1;
        let node = if self.take("-") {
            Node::Unary(|a| -a, Box::new(self.signed()?))
        } else {
            let base = self.atom()?;
            if self.take("^") {
                Node::Binary(f64::powf, Box::new(base), Box::new(self.signed()?))
            } else {
                base
            }
        };
        self.depth -= 1;
        Ok(node)
    }

    fn atom(&mut self) -> Result<Node, String> {
        if self.take("(") {
            return self.closed();
        }
        let rest = self.rest();
        let word = rest
            .find(|c: char| !(c.is_alphanumeric() || c == '_' || c == '.'))
            .unwrap_or(rest.len());
        let number = number_length(rest);
        if number > 0 {
            self.at += number;
            return rest[..number]
                .parse()
                .map(Node::Number)
                .map_err(|_| self.expected("a number"));
        }
        if word == 0 {
            return Err(self.expected("a number or a column"));
        }
        let name = &rest[..word];
        self.at += word;
        if let Some((_, function)) = FUNCTIONS.iter().find(|(known, _)| *known == name)
            && self.take("(")
        {
            self.sharp |= ["abs", "not"].contains(&name);
            return Ok(Node::Unary(*function, Box::new(self.closed()?)));
        }
        let known = self.columns.iter().position(|column| column == name);
        Ok(Node::Column(known.unwrap_or_else(|| {
            self.columns.push(name.to_owned());
            self.columns.len() - 1
        })))
    }

    fn closed(&mut self) -> Result<Node, String> {
        let inner = self.level(0)?;
        if self.take(")") {
            Ok(inner)
        } else {
            Err(self.expected("`)`"))
        }
    }
}

/// Characters of the number that a text starts with, with its exponent.
fn number_length(text: &str) -> usize {
    let bytes = text.as_bytes();
    let digits = |from: usize| {
        bytes[from..]
            .iter()
            .take_while(|b| b.is_ascii_digit())
            .count()
    };
    let mut length = digits(0);
    if bytes.get(length) == Some(&b'.') {
        let after = digits(length + 1);
        if length + after == 0 {
            return 0;
        }
        length += 1 + after;
    }
    if length > 0 && matches!(bytes.get(length), Some(b'e' | b'E')) {
        let sign = usize::from(matches!(bytes.get(length + 1), Some(b'+' | b'-')));
        let exponent = bytes
            .get(length + 1 + sign..)
            .map_or(0, |_| digits(length + 1 + sign));
        if exponent > 0 {
            length += 1 + sign + exponent;
        }
    }
    length
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str, values: &[f64]) -> f64 {
        Expression::parse(text).unwrap().value(&|k| values[k])
    }

    #[test]
    fn operators_bind_as_usual() {
        assert_eq!(value("1 + 2*3^2 - 4/2", &[]), 17.0);
        assert_eq!(value("-2^2 + (1 - 3)", &[]), -6.0);
        assert_eq!(value("2e-3*10", &[]), 0.02);
        assert_eq!(value("8 - 2 - 1", &[]), 5.0);
        assert_eq!(value("log10(flux_2/err)", &[100.0, 1.0]), 2.0);
        assert_eq!(value("a > 1 and b <= 2 or not(a == a)", &[2.0, 2.0]), 1.0);
        assert_eq!(value("android", &[7.0]), 7.0);
        assert!(value("a > 1", &[f64::NAN]).is_nan());
        let twice = Expression::parse("a*a + b").unwrap();
        assert_eq!(twice.columns(), ["a", "b"]);
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
            assert_eq!(
                Expression::parse(text).unwrap().is_smooth(),
                smooth,
                "{text}"
            );
        }
    }

    #[test]
    fn mistakes_are_reported_with_their_place() {
        for (text, expected) in [
            ("", "found the end, expected a number or a column"),
            ("a +", "found the end"),
            ("(a", "expected `)`"),
            ("a b", "found `b`, expected an operator"),
            ("a ? 2", "found `? 2`"),
            (&"(".repeat(10_000), "fewer brackets"),
        ] {
            let error = Expression::parse(text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
