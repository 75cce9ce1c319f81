//! From camera poses to the numbers that move them: parameters, the board's pose, posture errors.

use crate::bundle::pose_system::PoseSystem;
use crate::bundle::projection_model::{BOARD_SCALE, DEPTH_OFFSET, DEPTH_SCALE, EXTRINSICS, SHARED};
use crate::bundle::reduced::CameraStep;
use crate::bundle::state::State;
use crate::camera_kinematics::{CameraKinematics, CameraMotion, in_base};
use crate::model::extrinsic_index;
use crate::{CalibrationError, Parameter};
use nalgebra::{DMatrix, DVector, SVector, Translation3, UnitQuaternion, Vector3, Vector6};
use rayon::prelude::*;
use skclam_geometry::Isometry3;

/// What is unknown, in this order: the parameters, six numbers of the board, errors posture by posture.
pub(crate) struct Unknowns<'a> {
    pub parameters: &'a [Parameter],
    pub board: bool,
    /// Components of a posture's error; 0 for none.
    pub components: usize,
    pub postures: usize,
}

/// Columns of camera motion at a state: twists of the base frame.
pub(crate) struct Columns {
    /// A posture: 6 x parameters.
    by_parameter: Vec<DMatrix<f64>>,
    /// A posture: 6 x joints.
    by_joint: Vec<DMatrix<f64>>,
    /// Which shared number a parameter is.
    shared: Vec<Option<usize>>,
}

impl Unknowns<'_> {
    pub(crate) fn count(&self) -> usize {
        self.first_posture_error() + self.components * self.postures
    }

    pub(crate) fn first_posture_error(&self) -> usize {
        self.parameters.len() + if self.board { 6 } else { 0 }
    }

    pub(crate) fn shared_free(&self) -> bool {
        self.parameters.iter().any(|&parameter| shared_index(parameter).is_some())
    }

    pub(crate) fn columns(&self, motion: &CameraKinematics, state: &State) -> Result<Columns, CalibrationError> {
        let cameras = (0..self.postures)
            .into_par_iter()
            .map(|posture| {
                let error = motion.error_of(&state.posture_errors, posture);
                motion.linearize(&state.model, self.parameters, posture, error)
            })
            .collect::<Result<Vec<CameraMotion>, _>>()?;
        let matrix = |camera: &CameraMotion, columns: &[Vector6<f64>]| {
            let mut twists = DMatrix::zeros(6, columns.len());
            for (k, twist) in columns.iter().enumerate() {
                twists.fixed_view_mut::<6, 1>(0, k).copy_from(&in_base(&camera.base_from_camera, twist));
            }
            twists
        };
        Ok(Columns {
            by_parameter: cameras.iter().map(|camera| matrix(camera, &camera.by_parameter)).collect(),
            by_joint: cameras.iter().map(|camera| matrix(camera, &camera.by_joint[..self.components])).collect(),
            shared: self.parameters.iter().map(|&parameter| shared_index(parameter)).collect(),
        })
    }

    /// Normal matrix and right-hand side by the unknowns.
    pub(crate) fn assemble(&self, system: &PoseSystem, columns: &Columns) -> (DMatrix<f64>, DVector<f64>) {
        let (count, parameters) = (self.count(), self.parameters.len());
        let mut normal = DMatrix::zeros(count, count);
        let mut rhs = DVector::zeros(count);
        let selection = DMatrix::from_fn(SHARED, parameters, |row, k| f64::from(columns.shared[k] == Some(row)));
        let dense = |rows: usize, cols: usize, values: &[f64]| DMatrix::from_column_slice(rows, cols, values);
        // T_i = sum_j S_ij A_j + S_is A_s: what a twist of camera i has in common with the parameters.
        let coupling: Vec<DMatrix<f64>> = (0..self.postures)
            .into_par_iter()
            .map(|i| {
                let shared = dense(SHARED, 6, system.shared_by_pose[i].as_slice());
                let mut sum = shared.transpose() * &selection;
                for (j, by_parameter) in columns.by_parameter.iter().enumerate() {
                    sum += dense(6, 6, system.block(i, j).as_slice()) * by_parameter;
                }
                sum
            })
            .collect();
        let mut own = selection.transpose() * dense(SHARED, SHARED, system.shared.as_slice()) * &selection;
        let mut rhs_part = selection.transpose() * DVector::from_column_slice(system.shared_rhs.as_slice());
        for (i, by_parameter) in columns.by_parameter.iter().enumerate() {
            own += by_parameter.transpose() * &coupling[i];
            own += selection.transpose() * dense(SHARED, 6, system.shared_by_pose[i].as_slice()) * by_parameter;
            rhs_part += by_parameter.transpose() * DVector::from_column_slice(system.rhs[i].as_slice());
        }
        normal.view_mut((0, 0), (parameters, parameters)).copy_from(&((&own + own.transpose()) * 0.5));
        rhs.rows_mut(0, parameters).copy_from(&rhs_part);
        if self.board {
            let at = parameters;
            let mut cross = dense(SHARED, 6, system.shared_by_board.as_slice()).transpose() * &selection;
            for (i, by_parameter) in columns.by_parameter.iter().enumerate() {
                cross += dense(6, 6, system.board_by_pose[i].as_slice()) * by_parameter;
            }
            set_symmetric(&mut normal, at, 0, &cross);
            normal.view_mut((at, at), (6, 6)).copy_from(&system.board);
            rhs.rows_mut(at, 6).copy_from(&system.board_rhs);
        }
        for (i, by_joint) in columns.by_joint.iter().enumerate() {
            if self.components == 0 {
                break;
            }
            let at = self.first_posture_error() + i * self.components;
            set_symmetric(&mut normal, at, 0, &(by_joint.transpose() * &coupling[i]));
            if self.board {
                let cross = by_joint.transpose() * dense(6, 6, system.board_by_pose[i].as_slice()).transpose();
                set_symmetric(&mut normal, at, parameters, &cross);
            }
            for (j, other) in columns.by_joint.iter().enumerate().skip(i) {
                let block = by_joint.transpose() * (dense(6, 6, system.block(i, j).as_slice()) * other);
                set_symmetric(&mut normal, at, self.first_posture_error() + j * self.components, &block);
            }
            let rhs_part = by_joint.transpose() * DVector::from_column_slice(system.rhs[i].as_slice());
            rhs.rows_mut(at, self.components).copy_from(&rhs_part);
        }
        (normal, rhs)
    }

    /// What a step of the unknowns does to the cameras, to first order.
    pub(crate) fn camera_step(&self, columns: &Columns, step: &DVector<f64>) -> CameraStep {
        let parameters = step.rows(0, self.parameters.len()).into_owned();
        let twists = (0..self.postures).map(|i| {
            let mut twist = &columns.by_parameter[i] * &parameters;
            if self.components > 0 {
                let at = self.first_posture_error() + i * self.components;
                twist += &columns.by_joint[i] * step.rows(at, self.components);
            }
            Vector6::from_column_slice(twist.as_slice())
        });
        let shared = self.shared_free().then(|| {
            let mut shared = SVector::<f64, SHARED>::zeros();
            for (k, index) in columns.shared.iter().enumerate() {
                if let Some(index) = index {
                    shared[*index] += step[k];
                }
            }
            shared
        });
        CameraStep { twists: twists.collect(), shared }
    }

    /// The state after a step, its points untouched.
    pub(crate) fn stepped(
        &self,
        motion: &CameraKinematics,
        state: &State,
        step: &DVector<f64>,
    ) -> Result<State, CalibrationError> {
        let parameters = self.parameters.len();
        let mut moved = State {
            model: state.model.stepped(self.parameters, &step.as_slice()[..parameters])?,
            posture_errors: state.posture_errors.clone(),
            points: Vec::new(),
            base_from_board: state.base_from_board,
            frames: Vec::new(),
        };
        if let (true, Some(board)) = (self.board, &mut moved.base_from_board) {
            let twist = step.rows(parameters, 6);
            *board *= Isometry3::from_parts(
                Translation3::new(twist[0], twist[1], twist[2]),
                UnitQuaternion::from_scaled_axis(Vector3::new(twist[3], twist[4], twist[5])),
            );
            board.rotation.renormalize();
        }
        let at = self.first_posture_error();
        moved.posture_errors.iter_mut().zip(&step.as_slice()[at..]).for_each(|(value, change)| *value += change);
        moved.refresh_frames(motion)?;
        Ok(moved)
    }
}

fn set_symmetric(matrix: &mut DMatrix<f64>, row: usize, column: usize, block: &DMatrix<f64>) {
    matrix.view_mut((row, column), block.shape()).copy_from(block);
    if row != column {
        matrix.view_mut((column, row), (block.ncols(), block.nrows())).copy_from(&block.transpose());
    }
}

fn shared_index(parameter: Parameter) -> Option<usize> {
    match parameter {
        Parameter::Intrinsic(intrinsic) => Some(intrinsic as usize),
        Parameter::DepthOffset => Some(DEPTH_OFFSET),
        Parameter::DepthScale => Some(DEPTH_SCALE),
        Parameter::DepthExtrinsic(component) => Some(EXTRINSICS + extrinsic_index(component)),
        Parameter::BoardScale => Some(BOARD_SCALE),
        _ => None,
    }
}
