// The map update of ANYbotics' elevation_mapping without ROS: stand-ins for what it uses of ROS, PCL and Boost, and a C interface.
//
// anybotics_core.py extracts `struct Parameters`, `ElevationMap::add` and `ElevationMap::clean` from the given sources into
// parameters.inc and core.inc, and compiles them here unchanged.

#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include <Eigen/Dense>

#include "elevation_mapping/ElevationMapFunctors.hpp"
#include "elevation_mapping/ThreadSafeDataWrapper.hpp"
#include "grid_map_core/grid_map_core.hpp"

#define ROS_ERROR(...)
#define ROS_DEBUG(...)

namespace boost {
struct recursive_mutex : std::recursive_mutex {
  using scoped_lock = std::unique_lock<std::recursive_mutex>;
};
}  // namespace boost

namespace ros {
struct WallDuration {
  double seconds;
  double toSec() const { return seconds; }
};
struct Time {
  double seconds{0.0};
  static Time now() { return {std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count()}; }
  double toSec() const { return seconds; }
  uint64_t toNSec() const { return static_cast<uint64_t>(1e9 * seconds); }
  WallDuration operator-(const Time& other) const { return {seconds - other.seconds}; }
};
using WallTime = Time;
}  // namespace ros

namespace elevation_mapping {

float intAsFloat(const uint32_t bits) {
  float value;
  std::memcpy(&value, &bits, sizeof(value));
  return value;
}

struct Point {
  float x, y, z;
  Eigen::Vector3i getRGBVector3i() const { return {0, 0, 0}; }
};

struct PointCloudType {
  using Ptr = std::shared_ptr<PointCloudType>;
  std::vector<Point> points;
  size_t size() const { return points.size(); }
};

class ElevationMap {
 public:
  ElevationMap(double length, double resolution)
      : rawMap_({"elevation", "variance", "horizontal_variance_x", "horizontal_variance_y", "horizontal_variance_xy", "color", "time",
                 "dynamic_time", "lowest_scan_point", "sensor_x_at_lowest_scan", "sensor_y_at_lowest_scan",
                 "sensor_z_at_lowest_scan"}) {
    rawMap_.setBasicLayers({"elevation", "variance"});
    rawMap_.setGeometry(grid_map::Length(length, length), resolution, grid_map::Position(0.0, 0.0));
    rawMap_.clearAll();
    rawMap_["dynamic_time"].setZero();
  }
  bool add(PointCloudType::Ptr pointCloud, Eigen::VectorXf& pointCloudVariances, const ros::Time& timestamp,
           const Eigen::Affine3d& transformationSensorToMap);
  bool clean();

  grid_map::GridMap rawMap_;
  boost::recursive_mutex rawMapMutex_;
  ros::Time initialTime_;
#include "parameters.inc"
  ThreadSafeDataWrapper<Parameters> parameters_;
};

#include "core.inc"

}  // namespace elevation_mapping

using elevation_mapping::ElevationMap;

extern "C" {

ElevationMap* map_new(double length, double resolution) { return new ElevationMap(length, resolution); }

void map_delete(ElevationMap* map) { delete map; }

void map_move(ElevationMap* map, double x, double y) { map->rawMap_.move(grid_map::Position(x, y)); }

// Points (n, 3) [m] in {map}, variances (n,) [m^2] of their heights, position (3,) [m] of the sensor, time [s] of the scan.
void map_add(ElevationMap* map, const float* points, const float* variances, int64_t n, const double* sensor, double time) {
  auto cloud = std::make_shared<elevation_mapping::PointCloudType>();
  cloud->points.resize(n);
  static_assert(sizeof(elevation_mapping::Point) == 3 * sizeof(float));
  std::memcpy(cloud->points.data(), points, 3 * sizeof(float) * n);
  Eigen::VectorXf variance = Eigen::Map<const Eigen::VectorXf>(variances, n);
  Eigen::Affine3d pose = Eigen::Affine3d::Identity();
  pose.translation() << sensor[0], sensor[1], sensor[2];
  map->add(cloud, variance, ros::Time{time}, pose);
}

// Heights (n, n) [m] at the cells whose first one has its centre at (x, y); NaN outside and where unknown.
void map_heights(const ElevationMap* map, double x, double y, int64_t n, float* heights) {
  const auto& grid = map->rawMap_;
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t j = 0; j < n; ++j) {
      const grid_map::Position position(x + i * grid.getResolution(), y + j * grid.getResolution());
      const bool inside = grid.isInside(position);
      heights[i * n + j] = inside ? grid.atPosition("elevation", position) : std::numeric_limits<float>::quiet_NaN();
    }
  }
}
}
