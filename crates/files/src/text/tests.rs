//! Tables of text with all their oddities.

use crate::frames::reals;

use super::*;

fn table(text: &str, wanted: Option<&[&str]>) -> Result<DataFrame, String> {
    table_of(text.as_bytes(), wanted)
}

fn table_of(bytes: &[u8], wanted: Option<&[&str]>) -> Result<DataFrame, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.csv");
    std::fs::write(&path, bytes).unwrap();
    let request = Request {
        identities: &[],
        wanted,
        default_names: &CHALLENGE_COLUMNS,
        most_rows: 10,
    };
    read(&path, &request).map_err(|e| e.to_string())
}

fn column(table: &DataFrame, name: &str) -> Vec<f64> {
    reals(table.column(name).unwrap()).unwrap().into_owned()
}

#[test]
fn headers_and_separators_are_recognised() {
    let columns = |text| {
        let t = table(text, Some(&["y", "e1"])).unwrap_or_else(|e| panic!("{text:?}: {e}"));
        (column(&t, "y"), column(&t, "e1"))
    };
    let expected = (vec![2.0, 6.0], vec![3.0, -7e-3]);
    for text in [
        "x,y,e1,e2\n1,2,3,4\n5,6,-7e-3,8\n",
        "1 2 3 4\n 5  6 -7e-3 8\n",
        "# x y e1 e2\n1 2 3 4\n# note\n\n5\t6 -7e-3 8\n",
        "# made by hand\n1 2 3 4\n5 6 -7e-3 8\n",
        "e1,x,y\r\n3,1,2\r\n-7e-3,5,6\r\n",
        "# my method version one\n1 2 3 4\n5 6 -7e-3 8\n",
        "# made by hand, by me\n# x, y, e1, e2\n1 2 3 4\n5 6 -7e-3 8\n",
        "# note\nx,y,e1,e2\n1,2,3,4\n5,6,-7e-3,8\n",
        "\u{feff}x,y,e1,e2\n1,2,3,4\n5,6,-7e-3,8\n",
        // As other programs write them: an index without a name is of pandas.
        ",x,y,e1,e2\n0,1,2,3,4\n1,5,6,-7e-3,8\n",
        "\"\" x y e1 e2\n0 1 2 3 4\n1 5 6 -7e-3 8\n",
        "name,x,y,e1,e2\n\"a, b\",1,2,3,4\n\"c \"\"d\"\"\",5,\"6\",-7e-3,8\n",
        "\"a, b\",x,y,\"e1\",e2\n,1,2,3,4\n0,5,6,-7e-3,8\n",
        "x;y;e1;e2\n1;2;3;4\n5;6;-7e-3;8\n",
        "1;2;3;4\n5;6;-7e-3;8\n",
        "x\ty\te1\te2\n\t2\t3\t\n5\t6\t-7e-3\t8\n",
        "name\tx\ty\te1\te2\nmy galaxy\t1\t2\t3\t4\nno. 2\t5\t6\t-7e-3\t8\n",
        "5\t2 3 4\n5\t6 -7e-3 8\n",
        "x,y,e1,e2\n# made by me\n1,2,3,4\n# \"half, of it\n  # more\n \n5,6,-7e-3,8",
        "x y e1 e2\n# made by me, by hand\n1 2 3 4\n5 6 -7e-3 8\n",
        "# made by me, by hand\n1 2 3 4\n# a, b; c\n5 6 -7e-3 8\n",
        "x y e1 e2\n1,2,3,4\n5,6,-7e-3,8\n",
        "x, y, e1, e2\n1 2 3 4\n5 6 -7e-3 8\n",
        "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: x, datatype: float64}\nx y e1 e2 id\n\"\" 2 3 4 \"NGC 1\"\n5 6 -7e-3 8 b\n",
        "\u{feff}x;y;e1;e2\r\n1;2;3;4\r\n5;6;-7e-3;8\r\n",
    ] {
        assert_eq!(columns(text), expected, "{text:?}");
    }
    for blank in ["", "# no galaxies\n", "x,y,e1,e2\n"] {
        assert_eq!(columns(blank), (vec![], vec![]), "{blank:?}");
    }
    assert_eq!(table("x,y,e1,e2\n", None).unwrap().height(), 0);
    assert!(table("x,y,e1,e2\n1,2,NaN,nan\n", None).is_ok());
}

#[test]
fn columns_without_names_are_as_many_as_expected_or_numbered() {
    let names: Option<&[&str]> = Some(&["x", "y", "e1", "e2"]);
    for text in ["7 1 2 3 4\n8 5 6 7 8\n", "# by me\n7,1,2,3,4\n8,5,6,7,8\n"] {
        let error = table(text, names).unwrap_err();
        assert!(
            error.contains(
                "5 columns have no names (found the first row `7, 1, 2, 3, 4`, expected 4: x, y, e1, e2). Try: add a first line with the names"
            ),
            "{error}"
        );
        assert!(table(text, None).is_err());
        let numbered = table(text, Some(&["2", "5"])).unwrap();
        assert_eq!(column(&numbered, "2"), [1.0, 5.0]);
        assert_eq!(column(&numbered, "5"), [4.0, 8.0]);
    }
    // Later rows have as many columns as the first.
    let error = table("1 2 3 4\n5 6 7 8 9\n", names).unwrap_err();
    assert!(error.contains("line 2: 5 fields; expected 4"), "{error}");
}

#[test]
fn empty_cells_are_not_a_number() {
    let gaps = table("x,y,e1,e2\n,2,,4\n5, ,\"\",8\n", Some(&["x", "e1", "e2"])).unwrap();
    assert!(column(&gaps, "e1").iter().all(|v| v.is_nan()));
    assert!(column(&gaps, "x")[0].is_nan());
    assert_eq!(column(&gaps, "e2"), [4.0, 8.0]);
}

#[test]
fn compressed_tables_stream_and_are_bounded() {
    use std::io::Write;
    let gzip = |parts: &[&[u8]]| {
        let mut bytes = Vec::new();
        // One member after another, as compressors that work in parallel write them.
        for part in parts {
            let mut encoder = flate2::write::GzEncoder::new(&mut bytes, Default::default());
            encoder.write_all(part).unwrap();
            encoder.finish().unwrap();
        }
        bytes
    };
    let wanted: Option<&[&str]> = Some(&["x", "e2"]);
    let of = |bytes: &[u8]| table_of(bytes, wanted).map(|t| t.height());
    assert_eq!(of(&gzip(&[b"x,y,e1,e2\n1,2,", b"3,4\n5,6,7,8\n"])), Ok(2));
    let refuses = |bytes: &[u8], words: &str| {
        let error = of(bytes).unwrap_err();
        assert!(error.contains(words), "{error}");
    };
    let whole = gzip(&[b"x,y,e1,e2\n1,2,3,4\n5,6,7,8\n"]);
    refuses(&whole[..whole.len() - 5], "cannot read the table");
    let most = "line 11: expected at most 10 rows";
    refuses(&b"1,2,3,4\n".repeat(11), most);
    refuses(&gzip(&[&b"1 2 3 4\n".repeat(11)]), most);
    let long = vec![b' '; 2 * MAX_RECORD_BYTES];
    let zeros = vec![0; 2 * MAX_RECORD_BYTES];
    for start in [
        "",
        "#",
        "x,y,e1,e2\n1,2,3,",
        "x,y,e1,e2\n1,2,3,\"4\n5,6,7,8\n",
        "1 2 3 ",
    ] {
        for filling in [&long, &zeros] {
            refuses(
                &gzip(&[start.as_bytes(), filling]),
                "more than 1048576 bytes",
            );
        }
    }
}

#[test]
fn mistakes_are_named_with_their_line() {
    for (text, expected) in [
        (&b"x,y,e1,e2\n1,2,3\n"[..], "line 2: 3 fields; expected 4"),
        (
            b"x,y,e1,e2\n1,2,3,4\n1,2,3,four\n",
            "line 3: `four` in column `e2`",
        ),
        (
            b"x,y,e1,e2\r\n\r\n# note\r\n1,2,3,4\r\n1,2,3,four\r\n",
            "line 5: `four`",
        ),
        (
            b"# note\nx,y,e1,e2\n1,2,3,4\n# note\n\n1,2,3,four",
            "line 6: `four`",
        ),
        (b"1 2 3 4\n# note\n\n1 2 3 four\n", "line 4: `four`"),
        (b"x,y,e1,e2\n1,2,3,\xff\n", "line 2 is not UTF-8"),
        (b"x,y,e1,e2\n1,2,3,4\n1,2,\xff,4\n", "line 3 is not UTF-8"),
        (
            b"# note\r\n1,2,3,4\r\n1,2,\xff,4\r\n",
            "line 3 is not UTF-8",
        ),
        (b"# note\n1 2 3 4\n\n1 2 3 \xff", "line 4 is not UTF-8"),
        (
            b"x,y,g1,g2\n1,2,3,4\n",
            "no column `e2`; columns found: x, y, g1, g2",
        ),
        (
            b"x,y,e1,e2\n1,2,3,4\n1,2",
            "expected 4 (x, y, e1, e2). Try: a complete copy",
        ),
        (
            b"x;y;e1;e2\n1;2;3;-0,4\n",
            "`-0,4` in column `e2` is not a number. Try: numbers with decimal points",
        ),
    ] {
        let error = table_of(text, Some(&["x", "e2"])).unwrap_err();
        assert!(error.contains(expected), "{expected}: {error}");
    }
}

#[test]
fn fortran_writes_double_precision_with_a_d() {
    let text = "1.5D-02 2 3 -4d+1\n-.5D1 2 3 1.D0\n";
    let read = table(text, Some(&["x", "e2"])).unwrap();
    assert_eq!(column(&read, "x"), [0.015, -5.0]);
    assert_eq!(column(&read, "e2"), [-40.0, 1.0]);
    let error = table("1 2 3 d5\n", Some(&["x", "e2"])).unwrap_err();
    assert!(error.contains("`d5` in column `e2`"), "{error}");
}

#[test]
fn words_of_databases_are_truth_values_and_missing_numbers() {
    let words = "a,b\nTrue,NULL\nf,NA\nFALSE,--\nt,None\n\"true\",\\N\nF,N/A\n1,nan\n";
    let read = table(words, Some(&["a", "b"])).unwrap();
    assert_eq!(column(&read, "a"), [1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0]);
    assert!(column(&read, "b").iter().all(|value| value.is_nan()));
    // A name is no row, and a line of units no value.
    assert_eq!(
        column(&table("T,e1\n2,3\n", Some(&["T"])).unwrap(), "T"),
        [2.0]
    );
    let error = table("e1,e2\ndeg,deg\n1,2\n", Some(&["e1"])).unwrap_err();
    assert!(error.contains("units"), "{error}");
}
