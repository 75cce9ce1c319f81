//! What the program writes as JSON is what the published schemas describe, key by key.

mod support;

use serde_json::{Value, json};
use support::{small_copy, succeed, utf8};

const SUMMARY: &str = include_str!("../../skclam/schema/summary.schema.json");
const VALIDATION: &str = include_str!("../../skclam/schema/validation.schema.json");

/// A schema that also refuses keys that it does not describe; the published one lets readers ignore what is new.
fn strict(text: &str) -> jsonschema::Validator {
    fn close(schema: &mut Value) {
        match schema {
            Value::Object(object) => {
                object.values_mut().for_each(close);
                if object.contains_key("required") {
                    object.insert("additionalProperties".to_owned(), Value::Bool(false));
                }
            }
            Value::Array(list) => list.iter_mut().for_each(close),
            _ => {}
        }
    }
    let mut schema: Value = serde_json::from_str(text).unwrap();
    close(&mut schema);
    jsonschema::validator_for(&schema).unwrap()
}

fn assert_conforms(schema: &jsonschema::Validator, instance: &Value) {
    let errors: Vec<String> =
        schema.iter_errors(instance).map(|error| format!("{}: {error}", error.instance_path())).collect();
    assert!(errors.is_empty(), "{}", errors.join("\n"));
}

#[test]
fn results_conform_to_their_schemas() {
    let schema = strict(SUMMARY);
    let data = small_copy(16);
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let summary = |arguments: &[&str]| -> Value {
        serde_json::from_str(&succeed(&[arguments, &["--json", "--quiet"]].concat())).unwrap()
    };
    let whole = summary(&["run", utf8(data.path()), "--out", utf8(&out)]);
    assert_conforms(&schema, &whole);
    assert_eq!(whole["schema_version"], 2);
    // No tracks, no covariance, no map.
    let paper = folder.path().join("paper");
    assert_conforms(&schema, &summary(&["calibrate", utf8(data.path()), "--preset", "paper", "--out", utf8(&paper)]));
    assert_conforms(&strict(VALIDATION), &summary(&["validate", utf8(data.path()), "--rig", utf8(&out)]));

    // The test can fail: a key that is not described, one that is missing, a value of another type, version 1.
    for (pointer, value) in
        [("/scale/another", json!(1)), ("/held_out/folds", json!("six")), ("/schema_version", json!(1))]
    {
        let mut changed = whole.clone();
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        changed.pointer_mut(parent).unwrap()[key] = value;
        assert!(!schema.is_valid(&changed), "{pointer}");
    }
    let mut missing = whole;
    missing["calibration"].as_object_mut().unwrap().remove("rank");
    assert!(!schema.is_valid(&missing));
}
