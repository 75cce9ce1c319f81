//! The virtual cell: scene, renderer, sensor noise, postures and perturbed arms.
