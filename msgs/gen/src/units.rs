// SPDX-License-Identifier: MIT OR Apache-2.0
//! The units of the fields of ROS 2's own messages: REP 103's, or what the comments in the definitions say.

/// The unit of a field, where it has one and it is known: `rad/s`.
pub fn unit(type_name: &str, field: &str) -> Option<&'static str> {
    let index = UNITS.binary_search_by_key(&type_name, |(name, _)| name).ok()?;
    UNITS[index].1.iter().find(|(_, fields)| fields.contains(&field)).map(|(unit, _)| *unit)
}

type Units = &'static [(&'static str, &'static [&'static str])];

/// Sorted by the names of types.
#[rustfmt::skip]
const UNITS: &[(&str, Units)] = &[
    ("builtin_interfaces/msg/Duration", &[("s", &["sec"]), ("ns", &["nanosec"])]),
    ("builtin_interfaces/msg/Time", &[("s", &["sec"]), ("ns", &["nanosec"])]),
    ("geometry_msgs/msg/Accel", &[("m/s²", &["linear"]), ("rad/s²", &["angular"])]),
    ("geometry_msgs/msg/AccelWithCovariance", &[("m²/s⁴, m rad/s⁴ and rad²/s⁴", &["covariance"])]),
    ("geometry_msgs/msg/Inertia", &[
        ("kg", &["m"]),
        ("m", &["com"]),
        ("kg m²", &["ixx", "ixy", "ixz", "iyy", "iyz", "izz"]),
    ]),
    ("geometry_msgs/msg/Point", &[("m", &["x", "y", "z"])]),
    ("geometry_msgs/msg/Point32", &[("m", &["x", "y", "z"])]),
    ("geometry_msgs/msg/Pose2D", &[("m", &["x", "y"]), ("rad", &["theta"])]),
    ("geometry_msgs/msg/PoseWithCovariance", &[("m², m rad and rad²", &["covariance"])]),
    ("geometry_msgs/msg/Transform", &[("m", &["translation"])]),
    ("geometry_msgs/msg/Twist", &[("m/s", &["linear"]), ("rad/s", &["angular"])]),
    ("geometry_msgs/msg/TwistWithCovariance", &[("m²/s², m rad/s² and rad²/s²", &["covariance"])]),
    ("geometry_msgs/msg/Wrench", &[("N", &["force"]), ("N m", &["torque"])]),
    ("nav_msgs/msg/GridCells", &[("m", &["cell_width", "cell_height"])]),
    ("nav_msgs/msg/MapMetaData", &[("m per cell", &["resolution"]), ("cells", &["width", "height"])]),
    ("nav_msgs/msg/OccupancyGrid", &[("percent, -1 where it is unknown", &["data"])]),
    ("nav_msgs/srv/GetPlan_Request", &[("m", &["tolerance"])]),
    ("sensor_msgs/msg/BatteryState", &[
        ("V", &["voltage", "cell_voltage"]),
        ("°C", &["temperature", "cell_temperature"]),
        ("A", &["current"]),
        ("Ah", &["charge", "capacity", "design_capacity"]),
    ]),
    ("sensor_msgs/msg/CameraInfo", &[("pixels", &["height", "width"])]),
    ("sensor_msgs/msg/FluidPressure", &[("Pa", &["fluid_pressure"]), ("Pa²", &["variance"])]),
    ("sensor_msgs/msg/Illuminance", &[("lx", &["illuminance"]), ("lx²", &["variance"])]),
    ("sensor_msgs/msg/Image", &[("pixels", &["height", "width"]), ("bytes", &["step"])]),
    ("sensor_msgs/msg/Imu", &[
        ("rad²", &["orientation_covariance"]),
        ("rad/s", &["angular_velocity"]),
        ("rad²/s²", &["angular_velocity_covariance"]),
        ("m/s²", &["linear_acceleration"]),
        ("m²/s⁴", &["linear_acceleration_covariance"]),
    ]),
    ("sensor_msgs/msg/JointState", &[
        ("rad or m", &["position"]),
        ("rad/s or m/s", &["velocity"]),
        ("N m or N", &["effort"]),
    ]),
    ("sensor_msgs/msg/LaserScan", &[
        ("rad", &["angle_min", "angle_max", "angle_increment"]),
        ("s", &["time_increment", "scan_time"]),
        ("m", &["range_min", "range_max", "ranges"]),
    ]),
    ("sensor_msgs/msg/MagneticField", &[("T", &["magnetic_field"]), ("T²", &["magnetic_field_covariance"])]),
    ("sensor_msgs/msg/MultiEchoLaserScan", &[
        ("rad", &["angle_min", "angle_max", "angle_increment"]),
        ("s", &["time_increment", "scan_time"]),
        ("m", &["range_min", "range_max", "ranges"]),
    ]),
    ("sensor_msgs/msg/NavSatFix", &[
        ("degrees", &["latitude", "longitude"]),
        ("m", &["altitude"]),
        ("m²", &["position_covariance"]),
    ]),
    ("sensor_msgs/msg/PointCloud2", &[("bytes", &["point_step", "row_step"])]),
    ("sensor_msgs/msg/PointField", &[("bytes", &["offset"])]),
    ("sensor_msgs/msg/Range", &[
        ("rad", &["field_of_view"]),
        ("m", &["min_range", "max_range", "range"]),
        ("m²", &["variance"]),
    ]),
    ("sensor_msgs/msg/RegionOfInterest", &[("pixels", &["x_offset", "y_offset", "height", "width"])]),
    ("sensor_msgs/msg/Temperature", &[("°C", &["temperature"]), ("(°C)²", &["variance"])]),
    ("shape_msgs/msg/SolidPrimitive", &[("m", &["dimensions"])]),
    ("stereo_msgs/msg/DisparityImage", &[
        ("pixels", &["f", "min_disparity", "max_disparity", "delta_d"]),
        ("m", &["t"]),
    ]),
    ("trajectory_msgs/msg/JointTrajectoryPoint", &[
        ("rad or m", &["positions"]),
        ("rad/s or m/s", &["velocities"]),
        ("rad/s² or m/s²", &["accelerations"]),
        ("N m or N", &["effort"]),
    ]),
    ("trajectory_msgs/msg/MultiDOFJointTrajectoryPoint", &[("m/s² and rad/s²", &["accelerations"])]),
    ("visualization_msgs/msg/Marker", &[("m", &["scale"])]),
];

#[cfg(test)]
mod tests {
    use tautline_schema::Packages;

    use super::*;

    /// Nothing here has another name in the definitions, and nothing is looked for in vain.
    #[test]
    fn every_field_exists_once() {
        let mut packages = Packages::new();
        packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/../ros/definitions"));
        assert!(UNITS.is_sorted_by(|(one, _), (next, _)| one < next), "in the order of names");
        for (name, units) in UNITS {
            let definition = packages.definition(&name.parse().unwrap()).unwrap();
            let definition = definition.unwrap_or_else(|| panic!("{name} is not bundled"));
            let mut seen = Vec::new();
            for field in units.iter().flat_map(|(_, fields)| fields.iter()) {
                assert!(definition.fields.iter().any(|known| known.name == *field), "{name} has no {field}");
                assert!(!seen.contains(field), "{name}.{field} has two units");
                seen.push(field);
            }
        }
        assert_eq!(unit("sensor_msgs/msg/LaserScan", "time_increment"), Some("s"));
        assert_eq!(unit("sensor_msgs/msg/LaserScan", "intensities"), None);
        assert_eq!(unit("demo_msgs/msg/LaserScan", "time_increment"), None);
    }
}
