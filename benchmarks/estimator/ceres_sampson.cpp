// Ceres on the problem that `timing pairwise` writes: Sampson distances of matches, ten angles free.
//
// A residual block is a pair of postures with all its matches. Its fundamental matrix is a function of the ten angles, computed once a pair with Ceres'
// jets; every match then has its derivative by the chain rule over the nine entries. `--jets` leaves everything to automatic differentiation instead.
//
//   g++ -O3 -march=native -std=c++17 -I /usr/include/eigen3 ceres_sampson.cpp -o ceres_sampson -lceres -lglog
//   ./ceres_sampson PREFIX THREADS [--jets]

#include <ceres/ceres.h>

#include <Eigen/Dense>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <fstream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace {

constexpr int kAngles = 10;
constexpr int kJoints = 6;
constexpr std::array<double, kJoints> kA = {0.0, 0.1, 0.29, 0.085, 0.0, 0.0};
constexpr std::array<double, kJoints> kD = {0.29, 0.0, 0.0, 0.3, 0.0, 0.09};
const double kFocal = 0.5 * 1920.0 / std::tan(35.0 * M_PI / 180.0);

using Joints = std::array<double, kJoints>;
using Match = std::array<double, 4>;
using AngleJet = ceres::Jet<double, kAngles>;

template <typename T>
using Matrix3 = Eigen::Matrix<T, 3, 3>;
template <typename T>
using Vector3 = Eigen::Matrix<T, 3, 1>;

// Camera in the base: modified Denavit-Hartenberg, the first joint's angles not free.
template <typename T>
void BaseFromCamera(const T* angles, const Joints& q, Matrix3<T>* rotation, Vector3<T>* position) {
  *rotation = Matrix3<T>::Identity();
  *position = Vector3<T>::Zero();
  for (int i = 0; i < kJoints; ++i) {
    const T alpha = i == 0 ? T(0.0) : angles[2 * (i - 1)];
    const T theta = i == 0 ? T(q[0]) : T(q[i]) + angles[2 * (i - 1) + 1];
    using std::cos;
    using std::sin;
    const T ca = cos(alpha), sa = sin(alpha), c = cos(theta), s = sin(theta);
    Matrix3<T> link;
    link << c, -s, T(0.0), ca * s, ca * c, -sa, sa * s, sa * c, ca;
    *position += *rotation * Vector3<T>(T(kA[i]), -sa * kD[i], ca * kD[i]);
    *rotation = (*rotation * link).eval();
  }
  *position += *rotation * Vector3<T>(T(-0.06), T(0.0), T(0.04));
  Matrix3<T> mount;
  mount << T(0.0), T(1.0), T(0.0), T(-1.0), T(0.0), T(0.0), T(0.0), T(0.0), T(1.0);
  *rotation = (*rotation * mount).eval();
}

// K^-T [t]x R K^-1 of camera_a_from_camera_b.
template <typename T>
Matrix3<T> Fundamental(const T* angles, const Joints& a, const Joints& b) {
  Matrix3<T> base_from_a, base_from_b;
  Vector3<T> a_in_base, b_in_base;
  BaseFromCamera(angles, a, &base_from_a, &a_in_base);
  BaseFromCamera(angles, b, &base_from_b, &b_in_base);
  const Matrix3<T> rotation = base_from_a.transpose() * base_from_b;
  const Vector3<T> t = base_from_a.transpose() * (b_in_base - a_in_base);
  Matrix3<T> hat;
  hat << T(0.0), -t[2], t[1], t[2], T(0.0), -t[0], -t[1], t[0], T(0.0);
  Eigen::Matrix3d k_inverse;
  k_inverse << 1.0 / kFocal, 0.0, -959.5 / kFocal, 0.0, 1.0 / kFocal, -539.5 / kFocal, 0.0, 0.0, 1.0;
  return k_inverse.transpose().cast<T>() * hat * rotation * k_inverse.cast<T>();
}

struct Pair {
  Joints a, b;
  std::vector<Match> matches;
};

// Analytic by match, jets by pair.
class PairCost : public ceres::CostFunction {
 public:
  explicit PairCost(const Pair& pair) : pair_(pair) {
    set_num_residuals(static_cast<int>(pair.matches.size()));
    mutable_parameter_block_sizes()->push_back(kAngles);
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const bool wanted = jacobians != nullptr && jacobians[0] != nullptr;
    Eigen::Matrix3d f;
    Eigen::Matrix<double, 9, kAngles> by_angle;
    if (wanted) {
      std::array<AngleJet, kAngles> angles;
      for (int k = 0; k < kAngles; ++k) angles[k] = AngleJet(parameters[0][k], k);
      const Matrix3<AngleJet> jet = Fundamental(angles.data(), pair_.a, pair_.b);
      for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
          f(row, column) = jet(row, column).a;
          by_angle.row(3 * row + column) = jet(row, column).v.transpose();
        }
      }
    } else {
      f = Fundamental(parameters[0], pair_.a, pair_.b);
    }
    for (std::size_t i = 0; i < pair_.matches.size(); ++i) {
      const Match& m = pair_.matches[i];
      const double lx = f(0, 0) * m[2] + f(0, 1) * m[3] + f(0, 2);
      const double ly = f(1, 0) * m[2] + f(1, 1) * m[3] + f(1, 2);
      const double lz = f(2, 0) * m[2] + f(2, 1) * m[3] + f(2, 2);
      const double kx = f(0, 0) * m[0] + f(1, 0) * m[1] + f(2, 0);
      const double ky = f(0, 1) * m[0] + f(1, 1) * m[1] + f(2, 1);
      const double square = lx * lx + ly * ly + kx * kx + ky * ky;
      const double inverse = 1.0 / std::sqrt(square);
      const double residual = (m[0] * lx + m[1] * ly + lz) * inverse;
      residuals[i] = residual;
      if (!wanted) continue;
      // d r = (p_a^T dF p_b) / s - r (l . dl + k . dk) / s^2
      const double share = -residual * inverse * inverse;
      Eigen::Matrix<double, 1, 9> by_entry;
      const double pa[3] = {m[0], m[1], 1.0}, pb[3] = {m[2], m[3], 1.0};
      const double l[3] = {lx, ly, 0.0}, k[3] = {kx, ky, 0.0};
      for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
          by_entry[3 * row + column] =
              pa[row] * pb[column] * inverse + share * (l[row] * pb[column] + k[column] * pa[row]);
        }
      }
      Eigen::Map<Eigen::Matrix<double, 1, kAngles>>(jacobians[0] + kAngles * i).noalias() = by_entry * by_angle;
    }
    return true;
  }

 private:
  const Pair& pair_;
};

// The same, as a user without patience writes it.
struct JetCost {
  const Pair& pair;

  template <typename T>
  bool operator()(const T* const* parameters, T* residuals) const {
    const Matrix3<T> f = Fundamental(parameters[0], pair.a, pair.b);
    for (std::size_t i = 0; i < pair.matches.size(); ++i) {
      const Match& m = pair.matches[i];
      const Vector3<T> l = f.col(0) * T(m[2]) + f.col(1) * T(m[3]) + f.col(2);
      const T kx = f(0, 0) * m[0] + f(1, 0) * m[1] + f(2, 0);
      const T ky = f(0, 1) * m[0] + f(1, 1) * m[1] + f(2, 1);
      using std::sqrt;
      residuals[i] = (l[0] * m[0] + l[1] * m[1] + l[2]) / sqrt(l[0] * l[0] + l[1] * l[1] + kx * kx + ky * ky);
    }
    return true;
  }
};

std::vector<std::vector<double>> Table(const std::string& path, bool header, int skipped_columns) {
  std::ifstream file(path);
  if (!file) {
    std::fprintf(stderr, "%s cannot be read\n", path.c_str());
    std::exit(1);
  }
  std::vector<std::vector<double>> rows;
  std::string line;
  if (header) std::getline(file, line);
  while (std::getline(file, line)) {
    std::stringstream cells(line);
    std::vector<double> row;
    std::string cell;
    for (int k = 0; std::getline(cells, cell, ','); ++k) {
      if (k >= skipped_columns) row.push_back(std::stod(cell));
    }
    rows.push_back(row);
  }
  return rows;
}

double CpuSeconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: ceres_sampson PREFIX THREADS [--jets]\n");
    return 1;
  }
  const std::string prefix = argv[1];
  const int threads = std::atoi(argv[2]);
  const bool jets = argc > 3 && std::strcmp(argv[3], "--jets") == 0;
  const auto joints = Table(prefix + "-joints.csv", false, 0);
  const auto angles = Table(prefix + "-angles.csv", false, 1);
  std::map<std::pair<int, int>, Pair> pairs;
  std::size_t count = 0;
  for (const auto& row : Table(prefix + "-matches.csv", true, 0)) {
    Pair& pair = pairs[{static_cast<int>(row[0]), static_cast<int>(row[1])}];
    for (int k = 0; k < kJoints; ++k) {
      pair.a[k] = joints[static_cast<int>(row[0])][k];
      pair.b[k] = joints[static_cast<int>(row[1])][k];
    }
    pair.matches.push_back({row[2], row[3], row[4], row[5]});
    ++count;
  }
  double best = INFINITY, best_cpu = INFINITY;
  ceres::Solver::Summary summary;
  std::array<double, kAngles> x{};
  for (int repeat = 0; repeat < 20; ++repeat) {
    for (int k = 0; k < kAngles; ++k) x[k] = angles[k][0];
    const auto start = std::chrono::steady_clock::now();
    const double cpu = CpuSeconds();
    ceres::Problem problem;
    for (const auto& [key, pair] : pairs) {
      ceres::CostFunction* cost;
      if (jets) {
        auto* automatic = new ceres::DynamicAutoDiffCostFunction<JetCost, kAngles>(new JetCost{pair});
        automatic->AddParameterBlock(kAngles);
        automatic->SetNumResiduals(static_cast<int>(pair.matches.size()));
        cost = automatic;
      } else {
        cost = new PairCost(pair);
      }
      problem.AddResidualBlock(cost, nullptr, x.data());
    }
    ceres::Solver::Options options;
    options.linear_solver_type = ceres::DENSE_NORMAL_CHOLESKY;
    options.num_threads = threads;
    options.function_tolerance = 1e-12;
    options.parameter_tolerance = 1e-12;
    options.gradient_tolerance = 1e-16;
    options.logging_type = ceres::SILENT;
    ceres::Solve(options, &problem, &summary);
    best_cpu = std::fmin(best_cpu, CpuSeconds() - cpu);
    best = std::fmin(best, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  double error = 0.0;
  for (int k = 0; k < kAngles; ++k) error = std::fmax(error, std::fabs(x[k] - angles[k][1]) * 180.0 / M_PI);
  std::printf("cpu_ms=%.3f wall_ms=%.3f solver=Ceres %s (%s, dense normal Cholesky, threads %d): %d steps, theta_offset_6 %.9f rad, "
              "largest error %.5f deg, rms %.4f px\n",
              best_cpu * 1e3, best * 1e3, CERES_VERSION_STRING, jets ? "jets throughout" : "analytic by match, jets by pair", threads,
              summary.num_successful_steps + summary.num_unsuccessful_steps, x[9], error,
              std::sqrt(2.0 * summary.final_cost / static_cast<double>(count)));
}
