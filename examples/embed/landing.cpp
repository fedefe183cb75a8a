// One frame in, one line of JSON out: the network by ONNX Runtime, the solver by shortfinal.h. No Python.
//
//   landing MODEL.onnx FRAME.ppm  FX FY CX CY  LENGTH WIDTH  LEFT TOP RIGHT BOTTOM
//
// FRAME.ppm: binary PPM (P6), 8 bits. Focal lengths and principal point in pixels, no distortion; the
// runway's size in metres; a box around the runway in pixels, from a prior pose (sf_project) or a hand.
// The steps are those of LandingPipeline.step in pipeline.py with a box, and of detector.py; the test
// holds the answers against each other. Exit status: 0, or 2 with one line on what was wrong.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "shortfinal.h"

namespace {

constexpr int CORNERS = 4;
// Constants of pipeline.py.
constexpr double WIDE_MARGIN = 1.9, PRESENT = 0.5, FLAT = 1.5;
constexpr int LOOKS = 3;
// Of detector.py and crops.py.
constexpr int CORNER_LOOKS = 2, PATCH = 48;
constexpr double MAGNIFIED = 3.0, VISIBLE = 0.5, STILL_PX = 4.0, FINER = 1.1;
constexpr double HALF = 24.0, OF_WIDTH = 0.25, SIGMAS = 5.0, NARROWEST = 0.42261826174069944;  // sin 25
constexpr double SURVEY_SIGMA_M = 0.5;  // how well the runway's corners are known: ICAO Annex 15's 1 m with 95 %
constexpr double FALSE_ALARM_RATE = 1e-3, INTEGRITY_RISK = 1e-7, FAULT_PRIOR = 1e-4;

using Pixels = std::array<double, 2 * CORNERS>;                   // u0, v0, u1, v1, ...
using Covariance = std::array<double, 4 * CORNERS * CORNERS>;     // (8, 8)
using Box = std::array<double, 4>;                                // left, top, right, bottom, pixel centres

// ---- The model's description: as much JSON as that takes.

struct Json {
    double number = 0.0;  // or 0: null, false
    std::string text;
    std::vector<Json> items;
    std::vector<std::pair<std::string, Json>> members;

    const Json &operator[](const std::string &name) const {
        for (const auto &[key, value] : members)
            if (key == name) return value;
        throw std::runtime_error("the model's description lacks " + name);
    }
};

class JsonReader {
public:
    explicit JsonReader(const std::string &text) : at_(text.c_str()) {}

    Json value() {
        Json out;
        const char c = next();
        if (c == '{') {
            for (++at_; next() != '}'; skip(',')) {
                std::string key = string();
                skip(':');
                out.members.emplace_back(std::move(key), value());
            }
            ++at_;
        } else if (c == '[') {
            for (++at_; next() != ']'; skip(',')) out.items.push_back(value());
            ++at_;
        } else if (c == '"') {
            out.text = string();
        } else if (c >= 'a' && c <= 'z') {  // null, true, false
            out.number = c == 't';
            while (*at_ >= 'a' && *at_ <= 'z') ++at_;
        } else {
            char *end = nullptr;
            out.number = std::strtod(at_, &end);
            if (end == at_) throw std::runtime_error("the model's description is not JSON");
            at_ = end;
        }
        return out;
    }

private:
    char next() {
        while (*at_ == ' ' || *at_ == '\n' || *at_ == '\t' || *at_ == '\r') ++at_;
        if (!*at_) throw std::runtime_error("the model's description is not JSON");
        return *at_;
    }
    void skip(char c) {
        if (next() == c) ++at_;
    }
    std::string string() {
        std::string out;
        if (next() != '"') throw std::runtime_error("the model's description is not JSON");
        for (++at_; *at_ && *at_ != '"'; ++at_) {
            if (*at_ == '\\') ++at_;  // no name that is read here has an escape
            if (*at_) out += *at_;
        }
        if (*at_) ++at_;
        return out;
    }
    const char *at_;
};

// ---- Pictures and windows of them.

struct Image {
    int width = 0, height = 0;
    std::vector<uint8_t> rgb;

    double at(int x, int y, int channel) const {  // black beyond the border
        return x < 0 || y < 0 || x >= width || y >= height ? 0.0 : rgb[3 * (static_cast<size_t>(y) * width + x) + channel];
    }
};

// A square of the image, resampled to `size`; `left` and `top` count from the image's edge, so that a
// pixel u becomes (u + 1/2 - left) scale - 1/2.
struct Window {
    double left, top, side;
    int size;

    double scale() const { return size / side; }
    double apply(double px, int axis) const { return (px + 0.5 - (axis ? top : left)) * scale() - 0.5; }
    double inverse(double px, int axis) const { return (px + 0.5) / scale() + (axis ? top : left) - 0.5; }
};

int floor_div(int a, int b) { return static_cast<int>(std::floor(static_cast<double>(a) / b)); }

// From a picture's pixels (u, v, 1) to the image's.
struct Affine {
    double m[2][3];

    double operator()(double u, double v, int axis) const { return m[axis][0] * u + m[axis][1] * v + m[axis][2]; }
};

// Means of blocks of k[0] x k[1] pixels, from `low` to `high` (from the image's edge); where the first begins, in pixels.
Image block_means(const Image &image, const double (&low)[2], const double (&high)[2], const int (&k)[2], int (&start)[2]) {
    const int extent[2] = {image.width, image.height};
    int count[2];
    for (int axis = 0; axis < 2; ++axis) {
        const int origin = static_cast<int>(std::floor(low[axis] + 1e-6));
        const int needed = static_cast<int>(std::ceil((high[axis] - origin) / k[axis] - 1e-6));
        const int first = std::max(0, floor_div(-origin, k[axis]));
        const int last = std::min(needed, -floor_div(origin - extent[axis], k[axis]));
        start[axis] = origin + first * k[axis];
        count[axis] = std::max(0, last - first);
    }
    Image out{count[0], count[1], std::vector<uint8_t>(3 * static_cast<size_t>(count[0]) * count[1])};
    uint8_t *to = out.rgb.data();
    const double area = k[0] * k[1];
    for (int y = 0; y < out.height; ++y)
        for (int x = 0; x < out.width; ++x)
            for (int c = 0; c < 3; ++c) {
                double total = 0.0;
                for (int j = 0; j < k[1]; ++j)
                    for (int i = 0; i < k[0]; ++i)
                        total += image.at(start[0] + x * k[0] + i, start[1] + y * k[1] + j, c);
                // OpenCV rounds halves up for blocks of 2 x 2, to even otherwise.
                const bool up = k[0] == 2 && k[1] == 2;
                *to++ = static_cast<uint8_t>(up ? std::floor(total / 4.0 + 0.5) : std::nearbyint(total / area));
            }
    return out;
}

// warp_image of detector.py, of a square picture: blocks averaged where the image shrinks by two or more, then bilinear.
Image warp(const Image &image, Affine map, int size) {
    int k[2], start[2] = {0, 0};
    double low[2], high[2];
    for (int axis = 0; axis < 2; ++axis) {
        k[axis] = std::max(1, static_cast<int>(std::floor(std::hypot(map.m[axis][0], map.m[axis][1]) + 1e-6)));
        for (int corner = 0; corner < 4; ++corner) {
            const double edge = map(corner % 2 ? size - 0.5 : -0.5, corner / 2 ? size - 0.5 : -0.5, axis) + 0.5;
            low[axis] = corner ? std::min(low[axis], edge) : edge;
            high[axis] = corner ? std::max(high[axis], edge) : edge;
        }
    }
    Image means;
    const bool shrinks = std::max(k[0], k[1]) > 1;
    if (shrinks) {
        means = block_means(image, low, high, k, start);
        for (int axis = 0; axis < 2; ++axis) {
            map.m[axis][2] += 0.5 - start[axis];
            for (double &entry : map.m[axis]) entry /= k[axis];
            map.m[axis][2] -= 0.5;
        }
    }
    const Image &from = shrinks ? means : image;
    Image out{size, size, std::vector<uint8_t>(3 * static_cast<size_t>(size) * size)};
    uint8_t *to = out.rgb.data();
    for (int row = 0; row < size; ++row)
        for (int column = 0; column < size; ++column) {
            const double x = map(column, row, 0), y = map(column, row, 1);
            const int x0 = static_cast<int>(std::floor(x)), y0 = static_cast<int>(std::floor(y));
            const double a = x - x0, b = y - y0;
            for (int c = 0; c < 3; ++c) {
                const double above = (1 - a) * from.at(x0, y0, c) + a * from.at(x0 + 1, y0, c);
                const double below = (1 - a) * from.at(x0, y0 + 1, c) + a * from.at(x0 + 1, y0 + 1, c);
                *to++ = static_cast<uint8_t>(std::nearbyint((1 - b) * above + b * below));
            }
        }
    return out;
}

Image crop(const Image &image, const Window &window) {
    const double step = 1.0 / window.scale();
    return warp(image, {{{step, 0.0, window.inverse(0.0, 0)}, {0.0, step, window.inverse(0.0, 1)}}}, window.size);
}

double spread(const Image &image) {  // standard deviation of the levels
    double total = 0.0, squares = 0.0;
    for (uint8_t level : image.rgb) total += level, squares += static_cast<double>(level) * level;
    const double mean = total / image.rgb.size();
    return std::sqrt(std::max(0.0, squares / image.rgb.size() - mean * mean));
}

Image read_ppm(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    std::string magic;
    Image image;
    int most = 0;
    if (!(file >> magic >> image.width >> image.height >> most) || magic != "P6" || most != 255 || image.width < 1 ||
        image.height < 1 || image.width > 1 << 15 || image.height > 1 << 15)
        throw std::runtime_error(path + ": no binary PPM (P6) of 8 bits");
    file.get();
    image.rgb.resize(3 * static_cast<size_t>(image.width) * image.height);
    if (!file.read(reinterpret_cast<char *>(image.rgb.data()), static_cast<std::streamsize>(image.rgb.size())))
        throw std::runtime_error(path + ": cut short");
    return image;
}

// ---- The network.

struct Look {
    Window window{};
    Pixels mean{};      // of the frame
    Covariance cov{};   // likewise, px^2
    double visible = 0;  // of the corners, the least
    double present = 0;
};

class Network {
public:
    Network(const std::string &path, int threads)
        : session_(nullptr) {
        Ort::SessionOptions options;
        options.SetIntraOpNumThreads(threads);
        session_ = Ort::Session(environment_, path.c_str(), options);
        Ort::AllocatorWithDefaultOptions allocator;
        const auto text = session_.GetModelMetadata().LookupCustomMetadataMapAllocated("shortfinal", allocator);
        if (!text) throw std::runtime_error(path + ": not one of ours, it has no description");
        const Json info = JsonReader(text.get()).value();
        if (info["format"].number != 2) throw std::runtime_error(path + ": a description of another format than 2");
        if (info["keypoints"].items.size() != CORNERS) throw std::runtime_error(path + ": not a model of four corners");
        size = static_cast<int>(info["size"].number);
        margin = info["margin"].number;
        for (int c = 0; c < 3; ++c) {
            mean_[c] = static_cast<float>(info["mean"].items.at(c).number);
            std_[c] = static_cast<float>(info["std"].items.at(c).number);
        }
        for (size_t i = 0; i < session_.GetOutputCount(); ++i)
            sharpens_ = sharpens_ || std::string(session_.GetOutputNameAllocated(i, allocator).get()) == "corner_px";
        gain_.fill(1.0);
        if (const Json &calibration = info["calibration"]; !calibration.members.empty())
            for (int i = 0; i < 2 * CORNERS; ++i) gain_[i] = calibration["sigma_scale"].items.at(i).number;
    }

    Look look(const Image &frame, const Window &window) {
        std::vector<float> input(3 * static_cast<size_t>(size) * size);
        normalise(crop(frame, window), input.data());
        const auto given = tensor(input, {1, 3, size, size});
        const char *in[] = {"image"}, *out[] = {"mean_px", "cov_px", "visible", "present"};
        const auto answers = session_.Run(Ort::RunOptions{nullptr}, in, &given, 1, out, 4);
        return in_frame(window, answers[0].GetTensorData<float>(), answers[1].GetTensorData<float>(),
                        answers[2].GetTensorData<float>(), *answers[3].GetTensorData<float>());
    }

    // Each corner looked at by itself, in a patch of its own; one that is not seen there stays as it is. What is said of
    // the others is independent of it. Looked at again only if that shows more.
    void sharpen(const Image &frame, Look &look) {
        std::array<Affine, CORNERS> before{};
        for (int again = 0; sharpens_ && again < CORNER_LOOKS; ++again) {
            const auto maps = corner_patches(look);
            if (again && shows_no_more(maps, before)) break;
            before = maps;
            std::vector<float> patches(4 * 3 * static_cast<size_t>(PATCH) * PATCH), nothing;
            for (int k = 0; k < CORNERS; ++k)
                normalise(warp(frame, maps[k], PATCH), patches.data() + k * 3 * static_cast<size_t>(PATCH) * PATCH);
            bool yes = true;
            const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
            std::array<Ort::Value, 3> given{tensor(nothing, {0, 3, size, size}), tensor(patches, {1, 4, 3, PATCH, PATCH}),
                                            Ort::Value::CreateTensor<bool>(memory, &yes, 1, nullptr, 0)};
            const char *in[] = {"image", "patches", "sharpen"}, *out[] = {"corner_px", "corner_cov_px", "corner_visible"};
            const auto answers = session_.Run(Ort::RunOptions{nullptr}, in, given.data(), 3, out, 3);
            const float *mean = answers[0].GetTensorData<float>(), *cov = answers[1].GetTensorData<float>();
            const float *visible = answers[2].GetTensorData<float>();
            const auto seen = [&](int row) { return visible[row / 2] >= VISIBLE; };
            for (int r = 0; r < 8; ++r) {
                if (seen(r)) look.mean[r] = maps[r / 2](mean[r / 2 * 2], mean[r / 2 * 2 + 1], r % 2);
                for (int c = 0; c < 8; ++c) {
                    double entry = 0.0;  // A cov A^T, A from the patch to the frame
                    for (int i = 0; i < 2; ++i)
                        for (int j = 0; j < 2; ++j) {
                            const int a = r / 2 * 2 + i, b = c / 2 * 2 + j;
                            const double both = 0.5 * (static_cast<double>(cov[8 * a + b]) + cov[8 * b + a]);
                            entry += maps[r / 2].m[r % 2][i] * both * maps[c / 2].m[c % 2][j];
                        }
                    if (seen(r) && seen(c)) look.cov[8 * r + c] = entry * gain_[r] * gain_[c];
                    if (seen(r) != seen(c)) look.cov[8 * r + c] = 0.0;
                }
            }
            for (int r = 0; r < 8; ++r)
                if (!std::isfinite(look.mean[r]) || !(look.cov[9 * r] > 0.0))
                    throw std::runtime_error("the network's answer is no Gaussian");
        }
    }

    int size = 0;
    double margin = 0;

private:
    void normalise(const Image &picture, float *planes) const {
        const size_t plane = static_cast<size_t>(picture.width) * picture.height;
        for (size_t p = 0; p < plane; ++p)
            for (int c = 0; c < 3; ++c) planes[c * plane + p] = (picture.rgb[3 * p + c] / 255.0f - mean_[c]) / std_[c];
    }

    static Ort::Value tensor(std::vector<float> &values, const std::vector<int64_t> &shape) {
        const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
        return Ort::Value::CreateTensor<float>(memory, values.data(), values.size(), shape.data(), shape.size());
    }

    // crops.py's: for each corner, x along its end, y along its edge, as long as the end is wide or the look in doubt.
    static std::array<Affine, CORNERS> corner_patches(const Look &look) {
        std::array<Affine, CORNERS> maps{};
        for (int k = 0; k < CORNERS; ++k) {
            const double *here = look.mean.data() + 2 * k;
            double x[2], y[2];
            const double width = direction(here, look.mean.data() + 2 * (k ^ 1), x);
            direction(here, look.mean.data() + 2 * (3 - k), y);
            const double turn = x[0] * y[1] - x[1] * y[0];
            if (std::abs(turn) < NARROWEST) {
                const double side = turn >= 0 ? 1.0 : -1.0, ahead = x[0] * y[0] + x[1] * y[1] >= 0 ? 1.0 : -1.0;
                const double along = ahead * std::sqrt(1 - NARROWEST * NARROWEST);
                y[0] = along * x[0] - NARROWEST * side * x[1];
                y[1] = along * x[1] + NARROWEST * side * x[0];
            }
            const double doubt = std::sqrt(std::max(look.cov[18 * k], look.cov[18 * k + 9]));
            const double half = std::max({std::min(HALF, width), OF_WIDTH * width, SIGMAS * doubt, 2.0});
            for (int axis = 0; axis < 2; ++axis) {
                double *row = maps[k].m[axis];
                row[0] = x[axis] * half / (PATCH / 2), row[1] = y[axis] * half / (PATCH / 2);
                row[2] = here[axis] - (row[0] + row[1]) * (PATCH - 1) / 2;
            }
        }
        return maps;
    }

    static bool shows_no_more(const std::array<Affine, CORNERS> &maps, const std::array<Affine, CORNERS> &before) {
        for (int k = 0; k < CORNERS; ++k) {
            const Affine &now = maps[k], &then = before[k];
            const double middle = (PATCH - 1) / 2.0, size = std::hypot(then.m[0][0], then.m[1][0]);
            const double moved = std::hypot(now(middle, middle, 0) - then(middle, middle, 0),
                                            now(middle, middle, 1) - then(middle, middle, 1));
            if (moved > STILL_PX * size || size > FINER * std::hypot(now.m[0][0], now.m[1][0])) return false;
        }
        return true;
    }

    static double direction(const double *from, const double *to, double (&unit)[2]) {
        const double length = std::hypot(to[0] - from[0], to[1] - from[1]);
        for (int axis = 0; axis < 2; ++axis) unit[axis] = length > 0 ? (to[axis] - from[axis]) / length : 1.0 - axis;
        return length;
    }

    Look in_frame(const Window &window, const float *mean, const float *cov, const float *visible, float present) const {
        Look look;
        look.window = window;
        const double area = 1.0 / (window.scale() * window.scale());
        for (int r = 0; r < 8; ++r) {
            look.mean[r] = window.inverse(mean[r], r % 2);
            for (int c = 0; c < 8; ++c)  // equal to its transpose but for the rounding of float32
                look.cov[8 * r + c] = 0.5 * (static_cast<double>(cov[8 * r + c]) + cov[8 * c + r]) * gain_[r] * gain_[c] * area;
        }
        bool finite = present >= 0 && present <= 1;
        for (double value : look.mean) finite = finite && std::isfinite(value);
        for (double value : look.cov) finite = finite && std::isfinite(value);
        for (int i = 0; i < CORNERS; ++i) finite = finite && visible[i] >= 0 && visible[i] <= 1;
        if (!finite) throw std::runtime_error("the network's answer is no Gaussian");
        look.visible = *std::min_element(visible, visible + CORNERS);
        look.present = present;
        return look;
    }

    Ort::Env environment_{ORT_LOGGING_LEVEL_ERROR, "landing"};
    Ort::Session session_;
    float mean_[3] = {}, std_[3] = {};
    std::array<double, 2 * CORNERS> gain_{};
    bool sharpens_ = false;
};

// ---- Where to look, and what was seen: `see` of pipeline.py.

Box box_around(const double *px, int count) {
    Box box{px[0], px[1], px[0], px[1]};
    for (int i = 1; i < count; ++i)
        for (int axis = 0; axis < 2; ++axis) {
            box[axis] = std::min(box[axis], px[2 * i + axis]);
            box[2 + axis] = std::max(box[2 + axis], px[2 * i + axis]);
        }
    return box;
}

Window centre_crop(const Box &box, double margin, int size) {
    const double side = margin * std::max(box[2] - box[0], box[3] - box[1]);
    if (!(side > 0.0) || !(side < 1e6) || box[2] < box[0] || box[3] < box[1])
        throw std::runtime_error("box: not left < right, top < bottom");
    return {0.5 * (box[0] + box[2]) + 0.5 - side / 2, 0.5 * (box[1] + box[3]) + 0.5 - side / 2, side, size};
}

// Whether the crop has all corners inside, with half the intended border, and the runway not much too small.
bool frames(const Look &look, double margin) {
    if (look.visible < VISIBLE) return false;
    const double border = (1 - 1 / margin) / 4;
    double inside[8];
    for (int i = 0; i < 8; ++i) {
        inside[i] = look.window.apply(look.mean[i], i % 2) / (look.window.size - 1);
        if (!(inside[i] > border && inside[i] < 1 - border)) return false;
    }
    const Box box = box_around(inside, CORNERS);
    return std::max(box[2] - box[0], box[3] - box[1]) > 0.8 / margin;
}

// The look, and in `obstacle` why its keypoints are not to be used; empty if they may be.
Look see(Network &network, const Image &frame, const Box &box, std::string &obstacle) {
    if (box[2] < 0 || box[3] < 0 || box[0] >= frame.width || box[1] >= frame.height)
        return obstacle = "the runway's box lies outside the frame", Look{};
    const Window first = centre_crop(box, network.margin, network.size);
    if (spread(crop(frame, first)) < FLAT) return obstacle = "nothing to see: the crop is flat", Look{};
    Look look = network.look(frame, first);
    for (int i = 1; i < LOOKS && !frames(look, network.margin); ++i) {
        const double wider = look.visible >= VISIBLE ? network.margin : WIDE_MARGIN;
        look = network.look(frame, centre_crop(box_around(look.mean.data(), CORNERS), wider, network.size));
    }
    if (look.present < PRESENT) return obstacle = "no runway in view", look;
    if (!frames(look, network.margin)) return obstacle = "the runway does not settle inside the crop", look;
    if (look.window.scale() < MAGNIFIED) network.sharpen(frame, look);
    for (int i = 0; i < 8; ++i) {
        const double reach = 2 * std::sqrt(look.cov[9 * i]), last = (i % 2 ? frame.height : frame.width) - 1;
        if (look.mean[i] < reach || look.mean[i] > last - reach)
            obstacle = "a corner lies at the border of the frame, or beyond it";
    }
    return look;
}

// ---- Output.

void print(const char *name, const double *values, int count) {
    std::printf(", \"%s\": [", name);
    for (int i = 0; i < count; ++i)
        std::printf(std::isfinite(values[i]) ? "%s%.12g" : "%snull", i ? ", " : "", values[i]);
    std::printf("]");
}

double milliseconds() {
    return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

void run(char **arguments) {
    double n[10];
    for (int i = 0; i < 10; ++i) {
        char *end = nullptr;
        n[i] = std::strtod(arguments[3 + i], &end);
        if (*end || !std::isfinite(n[i])) throw std::invalid_argument(std::string(arguments[3 + i]) + ": no number");
    }
    if (!(std::min({n[0], n[1], n[4], n[5]}) > 0))
        throw std::invalid_argument("focal lengths and the runway's size must be positive");
    const sf_camera camera{n[0], n[1], n[2], n[3], {}};
    const double length = n[4], half = n[5] / 2;
    const double corners[12] = {0, half, 0, 0, -half, 0, length, -half, 0, length, half, 0};
    Network network(arguments[1], 1);
    const Image frame = read_ppm(arguments[2]);
    static sf_monitor monitor;
    if (sf_monitor_init(&monitor, 2 * CORNERS - 6, FALSE_ALARM_RATE, INTEGRITY_RISK, FAULT_PRIOR) != SF_CONVERGED)
        throw std::runtime_error("the monitor cannot be set up");

    const double start = milliseconds();
    std::string obstacle;
    Look look;
    try {
        look = see(network, frame, {n[6], n[7], n[8], n[9]}, obstacle);
    } catch (const std::runtime_error &error) {  // a frame of no use, and the flight goes on
        obstacle = error.what();
    }
    const double seen = milliseconds();
    sf_verdict verdict{SF_NOT_MONITORED, SF_CHECKED, 0, 0, 0, 0};
    sf_estimate estimate{};
    sf_levels levels{};
    if (obstacle.empty()) {
        const sf_problem problem{CORNERS, look.mean.data(), look.cov.data(), corners, &camera,
                                 nullptr, nullptr,          nullptr,         nullptr, SURVEY_SIGMA_M};
        sf_estimate_pose(&problem, &estimate);
        sf_check(&monitor, &estimate, &verdict);
        if (verdict.decision != SF_NOT_MONITORED) sf_protect(&monitor, &problem, &estimate, &levels);
    }
    const double done = milliseconds();

    std::printf("{\"decision\": \"%s\", \"reason\": \"%s\"", sf_decision_text(verdict.decision),
                obstacle.empty() ? sf_reason_text(verdict.reason) : obstacle.c_str());
    std::printf(", \"detect_ms\": %.3f, \"solve_ms\": %.3f", seen - start, done - seen);
    if (look.present > 0) print("keypoints_px", look.mean.data(), 8), print("keypoints_cov_px", look.cov.data(), 64);
    if (obstacle.empty()) {
        std::printf(", \"status\": \"%s\"", sf_status_text(estimate.status));
        print("position_m", estimate.position_m, 3), print("runway_from_camera", estimate.runway_from_camera, 9);
        print("pose_cov", estimate.cov, 36);
    }
    if (verdict.decision != SF_NOT_MONITORED) {
        print("p_value", &verdict.p_value, 1), print("protection", &levels.along_m, 5);
    }
    std::printf("}\n");
}

}  // namespace

int main(int count, char **arguments) {
    if (count != 13) {
        std::fprintf(stderr, "landing MODEL.onnx FRAME.ppm FX FY CX CY LENGTH WIDTH LEFT TOP RIGHT BOTTOM\n");
        return 2;
    }
    try {
        run(arguments);
    } catch (const std::exception &error) {
        std::fprintf(stderr, "landing: %s\n", error.what());
        return 2;
    }
    return 0;
}
