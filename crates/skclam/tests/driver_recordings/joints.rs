//! Joints as drivers write them.

use crate::world::*;
use skclam::import::ImportOptions;
use skclam::recordings::Selection;

fn with_names(names: &[&str]) -> ImportOptions {
    ImportOptions { joint_names: Some(names.iter().map(|&name| name.to_owned()).collect()), ..builtin() }
}

fn moving() -> ImportOptions {
    let mut options = builtin();
    options.selection.selection = Selection::Moving { every: 7 };
    options
}

/// Joints, topic, delay in ms, every how many-th time.
type Part = (&'static [usize], &'static str, i64, usize);

/// Splits the joint states: the joints of each part come in messages of their own, `delay_ms` later, every n-th time.
fn split(rate: f64, parts: &[Part]) -> Vec<Message> {
    let mut all = Vec::new();
    let mut step = 0;
    for message in good(rate) {
        let Content::Joints { positions, .. } = &message.content else {
            all.push(message);
            continue;
        };
        for (joints, topic, delay_ms, every) in parts {
            if step % every != 0 {
                continue;
            }
            let seconds = (message.stamp - ns(0.0)) as f64 * 1e-9 + *delay_ms as f64 * 1e-3;
            let at = if *delay_ms == 0 { positions.clone() } else { arm_at(seconds) };
            let content = Content::Joints {
                names: joints.iter().map(|&joint| ARM[joint].to_owned()).collect(),
                positions: joints.iter().map(|&joint| at[joint]).collect(),
            };
            let shift = delay_ms * 1_000_000;
            let (stamp, log) = (message.stamp + shift, message.log + shift);
            all.push(Message { topic: (*topic).to_owned(), stamp, log, content, ..message.clone() });
        }
        step += 1;
    }
    all
}

#[test]
fn the_good_recording_is_right_and_without_warnings() {
    for rate in [25.0, 50.0, 125.0] {
        right("good", &good(rate), &builtin(), &[]);
        let (_, dataset) = import_with(&good(rate), &moving()).unwrap();
        assert!(error_of(&dataset) < 1e-3 && dataset.len() > 15);
    }
}

#[test]
fn joints_spread_over_messages_and_topics_are_merged_by_time() {
    let one: &str = "/joint_states";
    let cases: Vec<Vec<Part>> = vec![
        vec![(&[0], one, 0, 1), (&[1, 2, 3, 4, 5], one, 0, 1)],
        vec![(&[1, 2, 3, 4, 5], one, 0, 1), (&[0], one, 7, 1)],
        vec![(&[0], one, 5, 3), (&[1, 2, 3, 4, 5], one, 0, 1)],
        vec![(&[5, 3], one, 0, 1), (&[0, 1, 2, 4], one, 2, 1)],
        vec![
            (&[0], one, 1, 1),
            (&[1], one, 2, 1),
            (&[2], one, 3, 1),
            (&[3], one, 4, 1),
            (&[4], one, 5, 1),
            (&[5], one, 6, 1),
        ],
        vec![(&[0], "/rail/joint_states", 0, 1), (&[1, 2, 3, 4, 5], "/arm/joint_states", 0, 1)],
        vec![(&[0], "/rail/joint_states", 6, 2), (&[5, 4, 3, 2, 1], "/arm/joint_states", 0, 1)],
        vec![(&[0, 1], "/a", 3, 1), (&[2, 3], "/b", 0, 2), (&[4, 5], "/c", 9, 1)],
        vec![(&[0, 1, 2], "/a", 0, 4), (&[3, 4, 5], "/b", 0, 1)],
        vec![(&[5, 4, 3, 2, 1, 0], one, 0, 1)],
    ];
    for (index, parts) in cases.iter().enumerate() {
        for rate in [50.0, 100.0] {
            right(&format!("split {index} at {rate} Hz"), &split(rate, parts), &builtin(), &[]);
        }
    }
    let overlapping: Vec<Part> = vec![(&[0, 1, 2, 3], "/a", 0, 1), (&[3, 4, 5], "/b", 0, 1)];
    refused("a joint on two topics", &split(50.0, &overlapping), &builtin(), &["\"R\" is on /a, /b", "--joints"]);
    let missing: Vec<Part> = vec![(&[0, 1, 2, 3, 5], "/a", 0, 1)];
    refused("a joint is nowhere", &split(50.0, &missing), &builtin(), &["6 joints", "has 5", "--joints"]);
    let once: Vec<Part> = vec![(&[0], one, 0, 100_000), (&[1, 2, 3, 4, 5], one, 0, 1)];
    let seldom = import_with(&split(50.0, &once), &builtin());
    assert!(seldom.is_err(), "a joint that is known at the beginning alone");
}

#[test]
fn what_is_not_used_is_not_validated() {
    let bad = [f64::NAN, f64::INFINITY, -f64::INFINITY, 1e300];
    for (index, value) in bad.into_iter().enumerate() {
        for (place, name) in [(0, "wheel"), (3, "gripper_finger"), (6, "left_wheel_joint")] {
            let mut messages = good(50.0);
            for message in &mut messages {
                if let Content::Joints { names, positions } = &mut message.content {
                    names.insert(place, name.to_owned());
                    positions.insert(place, value);
                }
            }
            right(&format!("{value} in {name} at {place}, {index}"), &messages, &builtin(), &[]);
        }
    }
    // On a topic of its own, and transforms that nobody needs.
    let mut messages = good(50.0);
    messages.push(Message { topic: "/gripper".into(), ..joints(0.5, &["finger"], vec![f64::NAN]) });
    let nobody = Content::Tf { parent: "a".into(), child: "b".into(), pose: [f64::NAN; 7] };
    messages.push(Message { topic: "/tf_static".into(), kind: TF, stamp: ns(1.0), log: ns(1.0), content: nobody });
    right("a gripper's topic", &messages, &builtin(), &[]);
}

#[test]
fn bad_values_are_passed_over_and_counted_wherever_they_are() {
    for (first, count) in [(0, 1), (0, 3), (0, 40), (200, 5), (690, 10), (350, 20)] {
        for value in [f64::NAN, f64::INFINITY] {
            let mut messages = good(50.0);
            let of_joints = messages.iter_mut().filter(|message| message.kind == JOINTS);
            for message in of_joints.skip(first).take(count) {
                if let Content::Joints { positions, .. } = &mut message.content {
                    positions.fill(value);
                }
            }
            right(
                &format!("{count} of {value} from {first}"),
                &messages,
                &builtin(),
                &[&count.to_string(), "NaN or infinite"],
            );
        }
    }
    let mut messages = good(50.0);
    for message in messages.iter_mut().filter(|message| message.kind == JOINTS) {
        if let Content::Joints { positions, .. } = &mut message.content {
            positions[2] = f64::NAN;
        }
    }
    refused("a joint that is never known", &messages, &builtin(), &["\"U\"", "--joints"]);
}

#[test]
fn messages_that_cannot_be_read_are_passed_over_and_counted() {
    let topics =
        ["/joint_states", "/camera/color/image_raw", "/camera/depth/image_rect_raw", "/camera/color/camera_info"];
    for topic in topics {
        for (first, garbage) in [(0, vec![]), (0, vec![0, 1, 0, 0, 1]), (5, vec![255; 40])] {
            let mut messages = good(50.0);
            for message in messages.iter_mut().filter(|message| message.topic == topic).skip(first).take(3) {
                message.content = Content::Bytes(garbage.clone());
            }
            right(
                &format!("{topic} from {first}"),
                &messages,
                &builtin(),
                &[&format!("3 messages on {topic} were passed over")],
            );
        }
    }
    // Names and positions of different numbers.
    let mut messages = good(50.0);
    messages.push(joints(0.001, &ARM, vec![0.0; 5]));
    right("five positions", &messages, &builtin(), &["6 joint names, but 5 positions"]);
    messages.retain(|message| message.kind != JOINTS);
    messages.push(joints(0.001, &ARM, vec![0.0; 5]));
    refused("nothing else", &messages, &builtin(), &["6 joint names, but 5 positions"]);
}

#[test]
fn names_that_are_given_name_nameless_positions() {
    for count in [6, 7, 8] {
        for empty in [false, true] {
            let mut messages = good(50.0);
            for message in &mut messages {
                if let Content::Joints { names, positions } = &mut message.content {
                    positions.resize(count, 0.3);
                    *names = vec![String::new(); if empty { count } else { 0 }];
                }
            }
            let mut names = ARM.to_vec();
            names.resize(count, "-");
            let name = format!("{count} positions, {empty}");
            right(&name, &messages, &with_names(&names), &[]);
            let advice = refused(&name, &messages, &builtin(), &["without names", "--joint-names"]);
            // The advice is followed word by word.
            let list = advice.split("--joint-names ").nth(1).unwrap().trim_end_matches(')');
            right(&name, &messages, &with_names(&list.split(',').collect::<Vec<_>>()), &[]);
            refused(
                &name,
                &messages,
                &with_names(&ARM[..5]),
                &[&format!("{count} positions without names"), "5 names"],
            );
        }
    }
    let mut messages = good(50.0);
    for message in &mut messages {
        if let Content::Joints { names, positions } = &mut message.content {
            names.clear();
            positions.reverse();
        }
    }
    // The arm's own names say which position is which, in whatever order the positions come.
    let reversed: Vec<&str> = ARM.iter().rev().copied().collect();
    right("reversed", &messages, &with_names(&reversed), &[]);
}

#[test]
fn a_name_that_is_given_twice_is_taken_once_or_refused() {
    for (joint, at) in [(0, 0), (0, 6), (2, 3), (5, 1), (3, 4)] {
        for options in [builtin(), with_names(&ARM)] {
            let twice = |offset: f64| {
                let mut messages = good(50.0);
                for message in &mut messages {
                    if let Content::Joints { names, positions } = &mut message.content {
                        let value = positions[joint] + offset;
                        names.insert(at, ARM[joint].to_owned());
                        positions.insert(at, value);
                    }
                }
                messages
            };
            right("the same value", &twice(0.0), &options, &[ARM[joint], "twice"]);
            right("not a number", &twice(f64::NAN), &options, &[ARM[joint], "twice"]);
            refused("another value", &twice(0.2), &options, &[&format!("\"{}\" twice", ARM[joint])]);
        }
    }
}

#[test]
fn names_that_do_not_fit_are_refused_by_name() {
    let messages = good(50.0);
    refused("too few", &messages, &with_names(&ARM[..5]), &["5 names", "6 joints"]);
    refused("twice", &messages, &with_names(&["S", "L", "U", "R", "B", "S"]), &["\"S\" twice"]);
    refused("unknown", &messages, &with_names(&["S", "L", "U", "R", "B", "X"]), &["\"X\"", "not among the joints"]);
}

#[test]
fn two_publishers_on_a_topic_are_noticed() {
    // What the second one writes, how often, and how much later.
    let zeros = |_: f64| vec![0.0; 6];
    let ready = |_: f64| vec![0.1, -0.5, 0.7, 0.0, 0.9, -1.2];
    let shifted = |seconds: f64| arm_at(seconds).iter().map(|value| value + 0.3).collect();
    let late = |seconds: f64| arm_at((seconds - 2.0).max(0.0));
    type Second = fn(f64) -> Vec<f64>;
    let sources: [(&str, Second); 4] = [("zeros", zeros), ("ready", ready), ("shifted", shifted), ("late", late)];
    for (name, source) in sources {
        for (rate, lag_s) in [(50.0, 0.01), (50.0, 0.0), (10.0, 0.004), (2.0, 0.003), (200.0, 0.001)] {
            let mut messages = good(50.0);
            for step in 0..(14.0 * rate) as usize {
                let seconds = step as f64 / rate + lag_s;
                messages.push(joints(seconds, &ARM, source(seconds)));
            }
            for options in [builtin(), moving()] {
                let name = format!("{name}, {rate} Hz, {lag_s} s later");
                refused(&name, &messages, &options, &["two sources", "/joint_states", "joint_state_publisher"]);
            }
        }
    }
    // With names in another order, and with one more.
    let mut messages = good(50.0);
    for step in 0..700 {
        let seconds = 0.02 * f64::from(step) + 0.006;
        messages.push(joints(seconds, &["gripper", "T", "B", "R", "U", "L", "S"], vec![0.0; 7]));
    }
    refused("another order", &messages, &builtin(), &["two sources"]);
    // One joint alone.
    let mut messages = good(50.0);
    (0..300).for_each(|step| messages.push(joints(0.04 * f64::from(step) + 0.005, &["B"], vec![-0.4])));
    refused("one joint", &messages, &moving(), &["two sources", "\"B\""]);
}

#[test]
fn a_lone_wrong_value_is_no_second_publisher() {
    for (seconds, value) in [(1.011, 3.0), (4.507, -2.0), (7.003, 0.0)] {
        let mut messages = good(50.0);
        messages.push(joints(seconds, &ARM, vec![value; 6]));
        right("lone", &messages, &builtin(), &["jump away"]);
        let (_, dataset) = import_with(&messages, &moving()).unwrap();
        assert!(error_of(&dataset) < 1e-3);
    }
}

#[test]
fn flicker_of_an_encoder_hides_no_stationary_interval() {
    for amplitude in [2e-4, 5e-4, 1e-3] {
        for (rate, period) in [(50.0, 2), (50.0, 5), (125.0, 7), (250.0, 11)] {
            let mut messages = good(rate);
            for (step, message) in messages.iter_mut().filter(|message| message.kind == JOINTS).enumerate() {
                if let Content::Joints { positions, .. } = &mut message.content {
                    positions[step % 6] += amplitude * f64::from((step / period) % 2 == 0);
                    positions[4] += amplitude * f64::from(step % period == 0);
                }
            }
            let name = format!("{amplitude} rad, {rate} Hz, {period}");
            let (summary, dataset) =
                import_with(&messages, &builtin()).unwrap_or_else(|error| panic!("{name}: {error}"));
            assert_eq!(dataset.len(), INTERVALS, "{name}: {:?}", summary.warnings);
            assert!(error_of(&dataset) < 2.5 * amplitude, "{name}");
        }
    }
}
