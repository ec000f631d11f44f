//! Keys of the primary header that an extension inherits.

use shearq_files::fits::ImageReader;

fn header(cards: &[(&str, &str)]) -> Vec<u8> {
    let card = |(key, value): &(&str, &str)| format!("{:<80}", format!("{key:<8}= {value:>20}"));
    let mut text: String = cards.iter().map(card).collect();
    text += "END";
    let size = text.len().next_multiple_of(2880);
    format!("{text:<size$}").into_bytes()
}

#[test]
fn an_extension_has_keys_of_the_primary_header_if_it_inherits() {
    let folder = tempfile::tempdir().unwrap();
    for (inherit, expected) in [("T", Some("'RA---TAN'")), ("F", None)] {
        let mut bytes = header(&[
            ("SIMPLE", "T"),
            ("BITPIX", "8"),
            ("NAXIS", "0"),
            ("EXTEND", "T"),
            ("CTYPE1", "'RA---TAN'"),
            ("GAIN", "2.0"),
        ]);
        bytes.extend(header(&[
            ("XTENSION", "'IMAGE   '"),
            ("BITPIX", "-32"),
            ("NAXIS", "2"),
            ("NAXIS1", "2"),
            ("NAXIS2", "2"),
            ("PCOUNT", "0"),
            ("GCOUNT", "1"),
            ("INHERIT", inherit),
            ("GAIN", "3.0"),
        ]));
        bytes.resize(bytes.len() + 2880, 0);
        let path = folder.path().join("a.fits");
        std::fs::write(&path, bytes).unwrap();
        let cards = ImageReader::open(&path).unwrap().cards().unwrap();
        assert_eq!(cards.get("CTYPE1").map(String::as_str), expected);
        // Its own keys count first.
        assert_eq!(cards["GAIN"], "3.0");
    }
}
