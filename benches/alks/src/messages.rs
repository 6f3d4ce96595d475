// SPDX-License-Identifier: MIT OR Apache-2.0
//! To and from ROS's messages.

/// Defines functions that convert the signals to messages of the crate `$ros`, and back: Tautline's and r2r's messages have the same
/// fields. What comes is checked: arrays of another length are `None`.
#[macro_export]
macro_rules! messages {
    ($ros:ident) => {
        use $crate::markers::{Kind, Marker, Scene};
        use $crate::mpc::HORIZON;
        use $crate::signals::{
            Command, Driver, Fast, Gps, Imu, LINES, Line, Lines, MAX_VEHICLES, Pose, State, Trajectory,
            Vehicle, Vehicles,
        };
        use $ros::geometry_msgs::msg as geometry;
        use $ros::nav_msgs::msg::Odometry;
        use $ros::sensor_msgs::msg as sensor;
        use $ros::std_msgs::msg as std_msg;
        use $ros::visualization_msgs::msg as visualization;

        fn header(stamp_ns: u64) -> std_msg::Header {
            let mut header = std_msg::Header::default();
            header.stamp.sec = (stamp_ns / 1_000_000_000) as i32;
            header.stamp.nanosec = (stamp_ns % 1_000_000_000) as u32;
            header
        }

        /// The stamp of a header, in ns; 0 if it is before the clock's begin.
        pub fn stamp_ns(header: &std_msg::Header) -> u64 {
            u64::try_from(header.stamp.sec).unwrap_or(0) * 1_000_000_000 + u64::from(header.stamp.nanosec)
        }

        pub fn float(data: f64) -> std_msg::Float64 {
            std_msg::Float64 { data }
        }

        /// What each of the eleven subscriptions keeps of its message, in the order of the topics; the odometry's is absolute then.
        pub mod keep {
            use super::*;
            use $crate::inputs::{Inputs, road_wheels, wheel_speed};

            pub fn speed(inputs: &mut Inputs, message: &std_msg::Float64) {
                inputs.speed_mps = message.data;
            }

            pub fn steering_wheel_angle(inputs: &mut Inputs, message: &std_msg::Float64) {
                inputs.steering_rad = road_wheels(message.data);
            }

            pub fn gps(inputs: &mut Inputs, message: &sensor::NavSatFix) {
                inputs.gps = from_gps(message);
            }

            pub fn odometry(inputs: &mut Inputs, message: &Odometry) {
                inputs.odometry = from_odometry(message).from($crate::START);
            }

            pub fn imu(inputs: &mut Inputs, message: &sensor::Imu) {
                inputs.imu = from_imu(message);
            }

            pub fn wheel_speeds(inputs: &mut Inputs, message: &sensor::JointState) {
                if let Some(wheels) = from_wheels(message) {
                    inputs.wheel_speed_mps = wheel_speed(&wheels);
                }
            }

            pub fn pedals(inputs: &mut Inputs, message: &sensor::Joy) {
                inputs.pedals = from_pair(message).unwrap_or(inputs.pedals);
            }

            pub fn status(inputs: &mut Inputs, message: &std_msg::UInt32) {
                inputs.status = message.data;
            }

            pub fn driver(inputs: &mut Inputs, message: &sensor::Joy) {
                inputs.driver = from_driver(message).unwrap_or(inputs.driver);
            }

            pub fn vehicles(inputs: &mut Inputs, message: &std_msg::Float64MultiArray) {
                inputs.vehicles = from_vehicles(message).unwrap_or(inputs.vehicles);
            }

            /// Lines that are none age.
            pub fn lines(inputs: &mut Inputs, message: &std_msg::Float64MultiArray) {
                if let Some(lines) = from_lines(message) {
                    (inputs.lines, inputs.lines_at_s) = (lines, $crate::now_s());
                }
            }
        }

        pub fn gps(fast: &Fast, stamp_ns: u64) -> sensor::NavSatFix {
            let Gps { latitude_deg: latitude, longitude_deg: longitude } = fast.gps;
            sensor::NavSatFix { header: header(stamp_ns), latitude, longitude, ..Default::default() }
        }

        pub fn from_gps(message: &sensor::NavSatFix) -> Gps {
            Gps { latitude_deg: message.latitude, longitude_deg: message.longitude }
        }

        pub fn odometry(pose: Pose, stamp_ns: u64) -> Odometry {
            let mut message = Odometry { header: header(stamp_ns), ..Default::default() };
            message.pose.pose = to_pose(pose);
            message
        }

        pub fn from_odometry(message: &Odometry) -> Pose {
            let geometry::Pose { position, orientation } = &message.pose.pose;
            Pose { x: position.x, y: position.y, yaw: 2.0 * orientation.z.atan2(orientation.w) }
        }

        fn to_pose(pose: Pose) -> geometry::Pose {
            let (sin, cos) = (pose.yaw / 2.0).sin_cos();
            geometry::Pose {
                position: geometry::Point { x: pose.x, y: pose.y, z: 0.0 },
                orientation: geometry::Quaternion { x: 0.0, y: 0.0, z: sin, w: cos },
            }
        }

        pub fn imu(fast: &Fast, stamp_ns: u64) -> sensor::Imu {
            let mut message = sensor::Imu { header: header(stamp_ns), ..Default::default() };
            message.linear_acceleration.x = fast.imu.acceleration_mps2;
            message.linear_acceleration.y = fast.imu.lateral_mps2;
            message.angular_velocity.z = fast.imu.yaw_rate_radps;
            message
        }

        pub fn from_imu(message: &sensor::Imu) -> Imu {
            Imu {
                acceleration_mps2: message.linear_acceleration.x,
                lateral_mps2: message.linear_acceleration.y,
                yaw_rate_radps: message.angular_velocity.z,
            }
        }

        pub fn wheels(fast: &Fast, stamp_ns: u64) -> sensor::JointState {
            let velocity = fast.wheels_radps.to_vec();
            sensor::JointState { header: header(stamp_ns), velocity, ..Default::default() }
        }

        pub fn from_wheels(message: &sensor::JointState) -> Option<[f64; 4]> {
            message.velocity.as_slice().try_into().ok()
        }

        pub fn pair(values: [f64; 2], stamp_ns: u64) -> sensor::Joy {
            let axes = values.iter().map(|value| *value as f32).collect();
            sensor::Joy { header: header(stamp_ns), axes, ..Default::default() }
        }

        pub fn from_pair(message: &sensor::Joy) -> Option<[f64; 2]> {
            let [a, b] = message.axes.as_slice().try_into().ok()?;
            Some([f64::from(a), f64::from(b)])
        }

        pub fn driver(fast: &Fast, stamp_ns: u64) -> sensor::Joy {
            pair([fast.driver.set_speed_mps, fast.driver.hands_on], stamp_ns)
        }

        pub fn from_driver(message: &sensor::Joy) -> Option<Driver> {
            from_pair(message).map(|[set_speed_mps, hands_on]| Driver { set_speed_mps, hands_on })
        }

        fn array(data: Vec<f64>) -> std_msg::Float64MultiArray {
            std_msg::Float64MultiArray { data, ..Default::default() }
        }

        pub fn vehicles(vehicles: &Vehicles) -> std_msg::Float64MultiArray {
            let of = |it: &Vehicle| [it.x, it.y, it.speed_mps, it.across_mps];
            array(vehicles.as_slice().iter().flat_map(of).collect())
        }

        pub fn from_vehicles(message: &std_msg::Float64MultiArray) -> Option<Vehicles> {
            let (rows, rest) = message.data.as_chunks::<4>();
            let mut vehicles = Vehicles { count: rows.len(), ..Vehicles::default() };
            if !rest.is_empty() || rows.len() > MAX_VEHICLES {
                return None;
            }
            for (vehicle, [x, y, speed_mps, across_mps]) in vehicles.of.iter_mut().zip(rows.iter().copied()) {
                *vehicle = Vehicle { x, y, speed_mps, across_mps };
            }
            Some(vehicles)
        }

        pub fn lines(lines: &Lines) -> std_msg::Float64MultiArray {
            let of = |line: &Line| line.coefficients.into_iter().chain([line.range_m]);
            array(lines.of.iter().flat_map(of).collect())
        }

        pub fn from_lines(message: &std_msg::Float64MultiArray) -> Option<Lines> {
            let (rows, rest) = message.data.as_chunks::<5>();
            let rows: &[[f64; 5]; LINES] = rows.try_into().ok().filter(|_| rest.is_empty())?;
            Some(Lines { of: rows.map(|[a, b, c, d, range_m]| Line { coefficients: [a, b, c, d], range_m }) })
        }

        pub fn command(command: &Command) -> std_msg::Float64MultiArray {
            array(vec![command.acceleration_mps2, command.steering_rad])
        }

        pub fn from_command(message: &std_msg::Float64MultiArray) -> Option<Command> {
            let [acceleration_mps2, steering_rad] = message.data.as_slice().try_into().ok()?;
            Some(Command { acceleration_mps2, steering_rad })
        }

        pub fn state(state: &State) -> std_msg::Float64MultiArray {
            let State { mode, lateral_m, target_mps, gap_m, unsolved } = *state;
            array(vec![f64::from(mode), lateral_m, target_mps, gap_m, f64::from(unsolved)])
        }

        pub fn trajectory(plan: &Trajectory) -> std_msg::Float64MultiArray {
            let all = [plan.lateral_m, plan.curvature, plan.speed_mps, plan.acceleration_mps2];
            array(all.iter().flatten().copied().collect())
        }

        pub fn from_trajectory(message: &std_msg::Float64MultiArray) -> Option<Trajectory> {
            let (rows, rest) = message.data.as_chunks::<HORIZON>();
            let rows: &[[f64; HORIZON]; 4] = rows.try_into().ok().filter(|_| rest.is_empty())?;
            let [lateral_m, curvature, speed_mps, acceleration_mps2] = *rows;
            Some(Trajectory { lateral_m, curvature, speed_mps, acceleration_mps2 })
        }

        pub fn markers(scene: &Scene, stamp_ns: u64) -> visualization::MarkerArray {
            visualization::MarkerArray {
                markers: scene.markers.iter().map(|of| marker(of, stamp_ns)).collect(),
            }
        }

        fn marker(of: &Marker, stamp_ns: u64) -> visualization::Marker {
            const DELETE: i32 = 2;
            let mut message = visualization::Marker {
                header: header(stamp_ns),
                ns: of.namespace.to_owned(),
                ..Default::default()
            };
            message.header.frame_id = "map".to_owned();
            (message.id, message.type_) = (of.id, of.kind as i32);
            message.action = if of.is_shown { 0 } else { DELETE };
            // A strip's points are in the map's frame already.
            let place = if of.kind == Kind::Cube { of.pose } else { Pose::default() };
            message.pose = to_pose(place);
            let [x, y, z] = of.scale;
            message.scale = geometry::Vector3 { x, y, z };
            let [r, g, b, a] = of.colour;
            message.color = std_msg::ColorRGBA { r, g, b, a };
            let points = of.points[..of.count].iter();
            message.points = points.map(|&[x, y]| geometry::Point { x, y, z: 0.0 }).collect();
            message
        }
    };
}
