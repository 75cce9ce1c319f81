//! The report and the comparison: the numbers of the page are those of summary.json, the page can be built again, and
//! nothing from outside becomes markup.

mod support;

use std::fs;
use std::path::Path;
use support::{edit, fail, small_copy, succeed, utf8};

/// A `<data>` element of a page: its value, where it says it is from, what is shown.
struct Shown<'a> {
    value: &'a str,
    from: &'a str,
    text: String,
}

fn shown(page: &str) -> Vec<Shown<'_>> {
    let mut found = Vec::new();
    for piece in page.split("<data value=\"").skip(1) {
        let (value, rest) = piece.split_once("\" data-from=\"").expect("its origin");
        let (from, rest) = rest.split_once("\">").expect("the end of the tag");
        let (text, _) = rest.split_once("</data>").expect("the end of the element");
        found.push(Shown { value, from, text: text.replace('\u{202f}', "") });
    }
    found
}

/// Half of the last digit that is shown.
fn rounding(text: &str) -> f64 {
    let (mantissa, exponent) = text.split_once('e').unwrap_or((text, "0"));
    let decimals = mantissa.split_once('.').map_or(0, |(_, decimals)| decimals.len() as i32);
    0.5 * 10f64.powi(exponent.parse::<i32>().expect("an exponent") - decimals)
}

fn check_numbers(page: &str, summary: &serde_json::Value) -> usize {
    let numbers = shown(page);
    for number in &numbers {
        let origin = summary.pointer(number.from).unwrap_or_else(|| panic!("{} is not in summary.json", number.from));
        assert_eq!(number.value, origin.to_string(), "{}", number.from);
        let exact = origin.as_f64().expect("a number");
        let text: f64 = number.text.parse().unwrap_or_else(|_| panic!("{}: {}", number.from, number.text));
        let limit = rounding(&number.text) * (1.0 + 1e-9);
        assert!((text - exact).abs() <= limit, "{}: {} is shown for {exact}", number.from, number.text);
    }
    numbers.len()
}

fn run(dataset: &Path, out: &Path, more: &[&str]) -> String {
    let mut arguments = vec!["run", utf8(dataset), "--quiet", "--out", utf8(out)];
    arguments.extend(more);
    succeed(&arguments)
}

#[test]
fn the_page_shows_the_summary_and_is_built_again_from_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = small_copy(8);
    let out = folder.path().join("result");
    run(dataset.path(), &out, &[]);
    let page = fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.len() < 15_000_000, "{} bytes", page.len());
    let summary: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(out.join("summary.json")).unwrap()).unwrap();
    let numbers = check_numbers(&page, &summary);
    assert!(numbers > 120, "only {numbers} numbers");
    for needed in
        ["/calibration/epipolar_after/median_px", "/map/depth_consistency_calibrated/median_mm", "/peak_memory_mib"]
    {
        assert!(page.contains(&format!("data-from=\"{needed}\"")), "{needed} is not shown");
    }
    let parameters = summary["calibration"]["parameters"].as_array().unwrap().len();
    for at in 0..parameters {
        assert!(page.contains(&format!("data-from=\"/calibration/parameters/{at}/calibrated\"")), "parameter {at}");
    }

    // The data set is not needed any more.
    drop(dataset);
    fs::remove_file(out.join("report.html")).unwrap();
    succeed(&["report", utf8(&out)]);
    assert!(fs::read_to_string(out.join("report.html")).unwrap() == page, "the page differs when built again");

    // A summary alone, as an older version wrote it.
    fs::remove_file(out.join("report_data.json")).unwrap();
    let other = folder.path().join("other.html");
    succeed(&["report", utf8(&out), "--out", utf8(&other)]);
    let page = fs::read_to_string(&other).unwrap();
    assert!(check_numbers(&page, &summary) > 100 && page.contains("no report_data.json"));
}

#[test]
fn names_from_outside_do_not_become_markup() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = small_copy(6);
    let rig = fs::read_to_string(dataset.path().join("rig.toml")).unwrap();
    let name = rig.lines().find(|line| line.starts_with("name")).expect("a name").to_owned();
    edit(dataset.path(), "rig.toml", &name, "name = '</script><script>alert(1)</script><img src=x onerror=alert(2)>'");
    let out = folder.path().join("<i>result");
    run(dataset.path(), &out, &[]);
    let other = folder.path().join("compare.html");
    succeed(&["compare", utf8(&out), utf8(&out), "--out", utf8(&other)]);
    for page in [out.join("report.html"), other] {
        let page = fs::read_to_string(page).unwrap();
        for markup in ["<script>alert", "<img src=x", "<i>result"] {
            assert!(!page.contains(markup), "{markup}");
        }
        assert!(page.contains("&lt;script&gt;alert(1)"));
    }
}

#[test]
fn results_are_compared_within_80_columns() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = small_copy(6);
    let [first, second] = ["first", "second"].map(|name| folder.path().join(name));
    run(dataset.path(), &first, &["--free", "angles"]);
    let printed = run(dataset.path(), &second, &["--preset", "paper"]);
    assert!(printed.contains("alpha_2"));
    let page = folder.path().join("compare.html");
    let table = succeed(&["compare", utf8(&first), utf8(&second), "--out", utf8(&page)]);
    assert!(table.contains("alpha_2") && table.contains("epipolar distance, median"), "{table}");
    for line in table.lines().chain(printed.lines()).filter(|line| !line.contains(utf8(folder.path()))) {
        if line.starts_with(['┌', '│', '└', '╞', '├']) {
            assert!(line.chars().count() <= 80, "{line}");
        }
    }
    let json: serde_json::Value =
        serde_json::from_str(&succeed(&["compare", utf8(&first), utf8(&second), "--json"])).unwrap();
    assert_eq!(json["runs"].as_array().unwrap().len(), 2);
    let page = fs::read_to_string(page).unwrap();
    assert!(page.contains("alpha_2") && page.contains("compared-residuals"));
}

#[test]
fn damaged_results_are_answered() {
    let folder = tempfile::tempdir().unwrap();
    assert!(fail(&["report", utf8(folder.path())]).contains("summary.json"));
    fs::write(folder.path().join("summary.json"), "{}").unwrap();
    assert!(fail(&["report", utf8(folder.path())]).contains("no summary of a run"));
    let dataset = small_copy(4);
    let out = folder.path().join("result");
    run(dataset.path(), &out, &[]);
    let data = out.join("report_data.json");
    let text = fs::read_to_string(&data).unwrap();
    fs::write(&data, text.replacen("\"format\":2", "\"format\":99", 1)).unwrap();
    assert!(fail(&["report", utf8(&out)]).contains("not of one piece"), "a file that was changed afterwards");
    // A result without a list of its files is read file by file.
    fs::remove_file(out.join("manifest.json")).unwrap();
    for (from, to, said) in [
        ("\"format\":2", "\"format\":99", "format 99"),
        ("\"calibrated_m\":\"", "\"calibrated_m\":\"AAAA", "map.calibrated_m"),
        ("\"calibrated_m\":\"", "\"calibrated_m\":\"!", "base64"),
        ("\"endpoints\":", "\"endpoints\":-", "invalid"),
    ] {
        assert!(text.contains(from), "{from}");
        fs::write(&data, text.replacen(from, to, 1)).unwrap();
        let message = fail(&["report", utf8(&out)]);
        assert!(message.contains("report_data.json") && message.contains(said), "{message}");
    }
    fs::write(&data, &text).unwrap();
    assert!(fail(&["compare", utf8(&out), "no/such"]).contains("no/such"));
}
