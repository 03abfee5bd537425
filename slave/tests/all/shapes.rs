//! Signed distances against closed forms, brute force and finite differences.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{Axes, Shape};
use proptest::prelude::*;

type V3 = Axes<3>;

fn point(size: f64) -> impl Strategy<Value = V3> {
    prop::array::uniform3(-size..size).prop_map(V3::from)
}

/// Distance to the surface of a box at the origin: the minimum over a dense grid on its six faces.
fn brute_force(x: &V3, half: &V3, grid: u32) -> f64 {
    let mut least = f64::INFINITY;
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            for i in 0..=grid {
                for j in 0..=grid {
                    let share = |k: u32| 2.0 * f64::from(k) / f64::from(grid) - 1.0;
                    let mut on = V3::zeros();
                    on[axis] = side * half[axis];
                    on[(axis + 1) % 3] = share(i) * half[(axis + 1) % 3];
                    on[(axis + 2) % 3] = share(j) * half[(axis + 2) % 3];
                    least = least.min((x - on).norm());
                }
            }
        }
    }
    least
}

proptest! {
    #[test]
    fn a_plane_is_a_projection(x in point(1.0), on in point(1.0), normal in point(3.0)) {
        prop_assume!(normal.norm() > 1e-3);
        let (distance, n) = Shape::plane(on, normal).unwrap().surface(&x);
        prop_assert!((distance - (x - on).dot(&normal) / normal.norm()).abs() < 1e-14);
        prop_assert!((n.norm() - 1.0).abs() < 1e-15 * 4.0);
    }

    #[test]
    fn a_ball_is_its_radius_around_its_centre(x in point(1.0), centre in point(1.0), radius in 0.01..1.0_f64) {
        let (distance, n) = Shape::sphere(centre, radius).unwrap().surface(&x);
        // The point moved back along the normal by the distance is on the surface.
        prop_assert!(((x - n * distance - centre).norm() - radius).abs() < 1e-14);
    }

    #[test]
    fn a_box_is_its_nearest_surface_point(x in point(2.0), half in prop::array::uniform3(0.1..1.0_f64)) {
        let half = V3::from(half);
        let (distance, n) = Shape::cuboid(V3::zeros(), half).unwrap().surface(&x);
        let inside = x.iter().zip(&half).all(|(x, h)| x.abs() < *h);
        prop_assert_eq!(distance < 0.0, inside);
        // The grid points are up to half a cell diagonal (1/24 of a face) from the nearest point.
        let cell = half.norm() / 24.0;
        let found = brute_force(&x, &half, 24);
        prop_assert!(found >= distance.abs() - 1e-12);
        prop_assert!(found * found <= distance * distance + 2.0 * cell * found + cell * cell);
        let on = x - n * distance;
        let (rest, _) = Shape::cuboid(V3::zeros(), half).unwrap().surface(&on);
        prop_assert!(rest.abs() < 1e-14);
    }

    #[test]
    fn normals_are_gradients(x in point(1.5), centre in point(0.2), half in prop::array::uniform3(0.2..0.9_f64)) {
        let half = V3::from(half);
        let shapes = [
            Shape::plane(centre, half).unwrap(),
            Shape::sphere(centre, half[0]).unwrap(),
            Shape::cuboid(centre, half).unwrap(),
        ];
        // Away from jumps of the gradient: inside, two equally near faces; a centre.
        let mut depths: Vec<f64> = (0..3).map(|i| (x - centre)[i].abs() - half[i]).collect();
        depths.sort_by(f64::total_cmp);
        prop_assume!(depths[2] - depths[1] > 1e-4 && (x - centre).norm() > 1e-2);
        prop_assume!((x - centre).iter().all(|q| q.abs() > 1e-4));
        prop_assume!(depths.iter().all(|d| d.abs() > 1e-4));
        let h = 1e-6;
        for shape in shapes {
            let (_, n) = shape.surface(&x);
            for axis in 0..3 {
                let mut step = V3::zeros();
                step[axis] = h;
                let slope = (shape.surface(&(x + step)).0 - shape.surface(&(x - step)).0) / (2.0 * h);
                // Rounding 1e-16 / h, curvature h² / 1e-4².
                prop_assert!((slope - n[axis]).abs() < 2e-4, "{shape:?} {axis}: {slope} {n}");
            }
        }
    }
}

#[test]
fn degenerate_places_have_a_normal() {
    let origin = V3::zeros();
    let (distance, n) = Shape::sphere(origin, 0.5).unwrap().surface(&origin);
    assert_eq!((distance, n), (-0.5, V3::new(1.0, 0.0, 0.0)));
    let half = V3::new(1.0, 0.5, 0.5);
    let (distance, n) = Shape::cuboid(origin, half).unwrap().surface(&origin);
    assert_eq!((distance, n), (-0.5, V3::new(0.0, 1.0, 0.0)));
    let (distance, n) = Shape::cuboid(origin, half).unwrap().surface(&V3::new(-1.0, 0.0, 0.0));
    assert_eq!((distance, n), (0.0, V3::new(-1.0, 0.0, 0.0)));
}
