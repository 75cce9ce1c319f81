//! The project's words are the field's. Sources, book and page are searched for words that were once used here for
//! things that have a common name.
//!
//! Text is cut into words, identifiers into their parts, so that a rule finds `sight`, `max_sights` and `LinearSight`
//! alike, and phrases across the lines of a comment.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Words that are not used, and what is written instead.
struct Rule {
    /// Words or phrases, lower case; a phrase finds the parts of an identifier too.
    found: &'static [&'static str],
    /// The field's term.
    write: &'static str,
    /// Contexts in which a word has its common meaning.
    allowed: &'static [&'static str],
}

const fn rule(found: &'static [&'static str], write: &'static str) -> Rule {
    Rule { found, write, allowed: &[] }
}

const RULES: &[Rule] = &[
    Rule {
        found: &["sight", "sights", "sighting", "sightings"],
        write: "observation",
        allowed: &["line of sight", "lines of sight"],
    },
    rule(&["told", "tell", "tells", "retold"], "reported, warned, distinguished, determined (by meaning)"),
    rule(&["hear", "hears", "heard"], "used, included"),
    rule(&["unseen"], "not identifiable, unobservable"),
    rule(&["base end", "hand end"], "base gauge, tool gauge"),
    Rule {
        found: &["joint deviation", "joint deviations"],
        write: "joint error per posture",
        allowed: &["alias = \"joint_deviation_deg"],
    },
    // Old keys of rig.toml stay readable.
    Rule {
        found: &["gear sin", "gear cos"],
        write: "transmission error",
        allowed: &["alias = \"gear_sin_deg", "alias = \"gear_cos_deg", "gear_sin_deg = [", "gear_cos_deg = ["],
    },
    rule(&["lever", "levers"], "gravity torque arm"),
    Rule {
        found: &["descent", "descend", "descends", "pull", "pulls", "information matrix"],
        write: "gradient, right-hand side, normal matrix, minimisation",
        allowed: &["git lfs pull"],
    },
    rule(&["way px", "ways px"], "residual_px"),
    Rule {
        found: &["freedom"],
        write: "dof",
        allowed: &["degrees of freedom", "degree of freedom", "degrees_of_freedom"],
    },
    rule(&["vain", "patience", "early looks"], "iteration budget"),
    rule(&["suspect", "suspects", "bumped"], "outlier posture, displaced camera"),
    rule(&["gather", "gathers", "gathered"], "front end, its result"),
    Rule {
        found: &["figure", "figures"],
        write: "metric, number, result",
        // Elements of the page, a key of version 1 of the summary, a figure of the paper.
        allowed: &["<figure", "</figure", "figure {", "figure,", "figure.chart", "figure_px", "figure_8"],
    },
    rule(&["grade", "grades", "traffic light"], "status"),
    rule(&["to their lines"], "epipolar distance"),
    Rule { found: &["surfaces apart", "agreement"], write: "depth consistency", allowed: &[] },
    Rule { found: &["growth"], write: "scale error", allowed: &["amortised growth"] },
    rule(&["camera mm per permille"], "scale sensitivity"),
    rule(&["partner", "partners"], "neighbour (max_neighbors)"),
    rule(&["still px", "camera fixed"], "static_px, ego mask"),
    Rule { found: &["share of", "shares of", "a share", "this share"], write: "fraction", allowed: &[] },
    rule(&["believe", "believed", "believes"], "valid, accepted, trusted"),
    rule(&["contest", "compete", "competes"], "non-maximum suppression"),
    rule(&["halvings"], "pyramid levels"),
    rule(&["whole turn", "whole turns", "modulo a turn"], "angle wrapping"),
    rule(&["end of a match", "ends of a match", "pair ends"], "endpoint"),
    rule(&["ways to count", "way to count"], "labelling"),
    Rule {
        found: &["stand", "stands", "standing", "stood"],
        write: "is, is in, represents; stationary interval",
        allowed: &["stand still", "stands still", "stood still", "standing still"],
    },
    rule(&["coat", "wear", "dice"], "material, weathering, rng"),
    rule(&["picture", "pictures"], "image, plot"),
    rule(&["at about most"], "at most"),
    rule(&["not looked at"], "ignored"),
    rule(&["how it went"], "run details"),
    rule(&["quadratic per m", "sigma per square metre"], "depth_sigma_per_m2"),
    rule(&["no image can"], "not identifiable from images"),
];

/// Files of which the words are counted, below the root of the repository.
fn files(root: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> =
        ["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md"].map(|name| root.join(name)).to_vec();
    let mut folders = vec![root.join("crates"), root.join("docs"), root.join("tests")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap().map(Result::unwrap) {
            let (path, name) = (entry.path(), entry.file_name());
            if entry.file_type().unwrap().is_dir() {
                // Dated records keep their words.
                if name != "target" && name != "decisions" {
                    folders.push(path);
                }
            } else if path
                .extension()
                .is_some_and(|ending| ["rs", "md", "js", "css", "html", "py"].iter().any(|known| ending == *known))
                && !path.ends_with("cli/tests/terms.rs")
            {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

/// A text on one line, the marks of comments left out, with the offset at which each line begins.
fn flattened(text: &str) -> (String, Vec<usize>) {
    let (mut flat, mut begins) = (String::with_capacity(text.len()), Vec::new());
    for line in text.lines() {
        begins.push(flat.len());
        flat += line.trim().trim_start_matches('/').trim_start_matches('!').trim_start();
        flat.push(' ');
    }
    (flat, begins)
}

/// Words and parts of identifiers in lower case, each with its place.
fn parts(flat: &str) -> Vec<(usize, String)> {
    let mut found: Vec<(usize, String)> = Vec::new();
    let mut before = ' ';
    for (at, letter) in flat.char_indices() {
        if letter.is_alphanumeric() {
            let begins = !before.is_alphanumeric() || (before.is_lowercase() && letter.is_uppercase());
            if begins {
                found.push((at, String::new()));
            }
            if let Some((_, word)) = found.last_mut() {
                word.extend(letter.to_lowercase());
            }
        }
        before = letter;
    }
    found
}

/// Line and words of every place where a rule applies.
fn breaches(text: &str) -> Vec<(usize, &'static str, &'static str)> {
    let (flat, begins) = flattened(text);
    let lower = flat.to_ascii_lowercase();
    let parts = parts(&flat);
    let mut found = Vec::new();
    for rule in RULES {
        for phrase in rule.found {
            let words: Vec<&str> = phrase.split(' ').collect();
            for run in parts.windows(words.len()) {
                let place = run[0].0;
                let allowed = |context: &&str| {
                    let near = lower.get(place.saturating_sub(context.len())..).unwrap_or(&lower[place..]);
                    let begin = lower.len() - near.len();
                    near.find(*context).is_some_and(|at| begin + at <= place)
                };
                if run.iter().zip(&words).all(|(part, word)| part.1 == *word) && !rule.allowed.iter().any(allowed) {
                    found.push((begins.partition_point(|&begin| begin <= place), *phrase, rule.write));
                }
            }
        }
    }
    found.sort_unstable();
    found
}

#[test]
fn the_words_are_the_field_s() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    if !root.join("ARCHITECTURE.md").is_file() {
        println!("skipped: the repository is not around this crate");
        return;
    }
    let (mut count, mut report) = (0, String::new());
    for path in files(&root) {
        let text = std::fs::read_to_string(&path).unwrap();
        let name = path.strip_prefix(&root).unwrap().display().to_string();
        for (line, phrase, write) in breaches(&text) {
            count += 1;
            writeln!(report, "{name}:{line}: \"{phrase}\": write {write}").unwrap();
        }
    }
    assert!(count == 0, "{count} words that have a common name\n{report}");
}

#[test]
fn words_are_found_in_identifiers_and_across_lines() {
    let phrases = |text: &str| breaches(text).into_iter().map(|(line, phrase, _)| (line, phrase)).collect::<Vec<_>>();
    assert_eq!(phrases("let max_sights = LinearSight::new();"), [(1, "sight"), (1, "sights")]);
    assert_eq!(phrases("/// The ways\n/// to count them; insight is none."), [(1, "ways to count")]);
    assert_eq!(phrases("in the line of sight, six degrees\n/// of freedom, <figure class>"), []);
    assert_eq!(phrases("it stands still, it stands"), [(1, "stands")]);
}
