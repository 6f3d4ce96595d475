// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a visualizer draws: in the map's frame, as rviz's markers have it.

use crate::inputs::Inputs;
use crate::mpc::PLAN_STEP_S;
use crate::signals::{LINES, MAX_VEHICLES, PLAN_POINTS, Pose, Trajectory};
use crate::vehicle::LENGTH_M;

/// Markers of a scene: the car, its trajectory, lines, vehicles.
pub const MARKERS: usize = 2 + LINES + MAX_VEHICLES;
const LINE_POINTS: usize = 28;

/// What a marker is; the numbers are those of `visualization_msgs/msg/Marker`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(i32)]
pub enum Kind {
    /// A box of the size `scale`.
    #[default]
    Cube = 1,
    /// A line through `points`, of the width `scale[0]`.
    LineStrip = 4,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marker {
    pub kind: Kind,
    /// Whether it is there: otherwise whoever draws takes it away.
    pub is_shown: bool,
    pub namespace: &'static str,
    pub id: i32,
    pub pose: Pose,
    /// In m.
    pub scale: [f64; 3],
    /// Red, green, blue, opacity: 0 to 1.
    pub colour: [f32; 4],
    pub count: usize,
    /// In the map, on the ground.
    pub points: [[f64; 2]; PLAN_POINTS],
}

const EMPTY: Marker = Marker {
    kind: Kind::Cube,
    is_shown: false,
    namespace: "",
    id: 0,
    pose: Pose { x: 0.0, y: 0.0, yaw: 0.0 },
    scale: [0.0; 3],
    colour: [0.0; 4],
    count: 0,
    points: [[0.0; 2]; PLAN_POINTS],
};

/// All markers, always as many, each at its place.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    pub markers: [Marker; MARKERS],
}

impl Default for Scene {
    fn default() -> Scene {
        Scene { markers: [EMPTY; MARKERS] }
    }
}

impl Scene {
    /// Draws what is known, around a car at `odometry`.
    ///
    /// # Real-time
    /// O(markers and points), no allocation.
    pub fn draw(&mut self, odometry: Pose, inputs: &Inputs, trajectory: Option<&Trajectory>) {
        let [car, way, others @ ..] = &mut self.markers;
        *car = solid("car", 0, odometry, [0.1, 0.6, 0.2, 1.0]);
        *way = Marker { is_shown: trajectory.is_some(), ..strip("trajectory", 0, 0.4, [0.1, 0.7, 0.9, 0.9]) };
        if let Some(trajectory) = trajectory {
            let mut x = 0.0;
            let ego = centre(inputs);
            for (lateral, speed) in trajectory.lateral_m.iter().zip(&trajectory.speed_mps) {
                x += speed * PLAN_STEP_S;
                way.push(odometry, x, ego(x) + lateral);
            }
        }
        let (lines, vehicles) = others.split_at_mut(LINES);
        for ((id, marker), line) in (0..).zip(lines).zip(&inputs.lines.of) {
            *marker = strip("lines", id, 0.15, [1.0, 1.0, 1.0, 1.0]);
            marker.is_shown = line.range_m > 0.0;
            for index in 0..LINE_POINTS {
                let x = line.range_m * index as f64 / (LINE_POINTS - 1) as f64;
                marker.push(odometry, x, line.y(x));
            }
        }
        let seen = inputs.vehicles.as_slice();
        for (index, marker) in vehicles.iter_mut().enumerate() {
            let vehicle = seen.get(index);
            let place = vehicle.map_or(Pose::default(), |of| Pose { x: of.x, y: of.y, yaw: 0.0 });
            *marker = solid("vehicles", index as i32, place.from(odometry), [0.8, 0.2, 0.2, 0.9]);
            marker.is_shown = vehicle.is_some();
        }
    }
}

impl Marker {
    /// A point as the car sees it.
    fn push(&mut self, car: Pose, x: f64, y: f64) {
        let place = Pose { x, y, yaw: 0.0 }.from(car);
        if let Some(point) = self.points.get_mut(self.count) {
            (*point, self.count) = ([place.x, place.y], self.count + 1);
        }
    }
}

fn centre(inputs: &Inputs) -> impl Fn(f64) -> f64 + use<> {
    let (right, left) = (inputs.lines.of[1], inputs.lines.of[2]);
    move |x| (right.y(x) + left.y(x)) / 2.0
}

fn solid(namespace: &'static str, id: i32, pose: Pose, colour: [f32; 4]) -> Marker {
    let scale = [LENGTH_M, 1.95, 1.6];
    Marker { kind: Kind::Cube, is_shown: true, namespace, id, pose, scale, colour, ..EMPTY }
}

fn strip(namespace: &'static str, id: i32, width: f64, colour: [f32; 4]) -> Marker {
    Marker { kind: Kind::LineStrip, is_shown: true, namespace, id, scale: [width, 0.0, 0.0], colour, ..EMPTY }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::signals::{Line, Vehicle};

    #[test]
    fn what_is_seen_ahead_is_drawn_where_the_car_looks() {
        let mut inputs = Inputs::default();
        inputs.vehicles.count = 1;
        inputs.vehicles.of[0] = Vehicle { x: 10.0, ..Vehicle::default() };
        inputs.lines.of[1] = Line { coefficients: [-2.0, 0.0, 0.0, 0.0], range_m: 100.0 };
        let mut scene = Scene::default();
        let north = Pose { x: 5.0, y: 5.0, yaw: std::f64::consts::FRAC_PI_2 };
        scene.draw(north, &inputs, Some(&Trajectory::default()));
        let vehicle = scene.markers[2 + LINES];
        assert!((vehicle.pose.x - 5.0).abs() < 1e-9 && (vehicle.pose.y - 15.0).abs() < 1e-9);
        let line = scene.markers[2 + 1];
        assert_eq!((line.count, line.kind), (LINE_POINTS, Kind::LineStrip));
        assert!((line.points[LINE_POINTS - 1][0] - 7.0).abs() < 1e-9, "2 m to the right is east");
        assert!((line.points[LINE_POINTS - 1][1] - 105.0).abs() < 1e-9);
        let shown = scene.markers.iter().filter(|marker| marker.is_shown).count();
        assert_eq!(shown, 4, "the car, the trajectory, one line, one vehicle");
        assert_eq!(scene.markers[1].count, PLAN_POINTS);
    }
}
