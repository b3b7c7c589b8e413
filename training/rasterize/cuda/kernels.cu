// Kernels of the cuda backend. source.py puts the constants, the harmonics and Vector in front of them.
//
// Splats are projected to ellipses by a thread each (project, project_backward), listed per tile of 16x16 pixels
// (list_pairs), and blended by a workgroup per tile (blend, blend_backward, weigh). A warp draws a strip of 8x4 pixels
// of its tile, and skips splats that do not touch the strip. compare and compare_backward are the photometric loss.
// Notation and derivations are those of gpu/shaders.

#define ALL 0xffffffffu
#define TILE 16
#define THREADS 256  // threads of a tile, and splats that it fetches at once
#define STRIPS 8
#define STRIP_WIDTH 8
#define STRIP_HEIGHT 4
#define ROW 12  // numbers of a projected splat: mean, half size of its box, conic, log2 opacity, depth, channels
#define SUMS 8  // numbers of a splat's gradient: g, g e, g e et, and |g e|, see blend_backward
#define GRADIENTS 11  // these and the gradient by colour
#define BASES 25  // harmonics of degree 4

struct View {
    float pose[12];  // world to camera, row by row
    float position[3];
    float fx, fy, cx, cy;
    float low_x, low_y, high_x, high_y;  // limits of x/z and y/z in the Jacobian
    float near, min_scale;
    int width, height, across, down;  // of the image in pixels, and in tiles
    int count, terms, degree;
};

struct Image {
    float red, green, blue;  // of the background
    int width, height, across;
};

__device__ inline Vector vector(float x, float y, float z) { Vector v = {x, y, z}; return v; }
__device__ inline Vector load(const float* at) { return vector(at[0], at[1], at[2]); }
__device__ inline Vector operator+(Vector a, Vector b) { return vector(a.x + b.x, a.y + b.y, a.z + b.z); }
__device__ inline Vector operator-(Vector a, Vector b) { return vector(a.x - b.x, a.y - b.y, a.z - b.z); }
__device__ inline Vector operator*(Vector a, Vector b) { return vector(a.x * b.x, a.y * b.y, a.z * b.z); }
__device__ inline Vector operator*(float k, Vector a) { return vector(k * a.x, k * a.y, k * a.z); }
__device__ inline float dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ inline Vector cross(Vector a, Vector b) {
    return vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
__device__ inline float clamp(float x, float low, float high) { return fminf(fmaxf(x, low), high); }
__device__ inline int clamp_int(int x, int low, int high) { return x < low ? low : x > high ? high : x; }

__device__ inline float sigmoid(float x) {
    float e = expf(-fabsf(x));
    return (x >= 0.0f ? 1.0f : e) / (1.0f + e);
}

// -- projection ------------------------------------------------------------------------------------------------------

struct Matrix { Vector row[3]; };

__device__ inline Matrix transposed(Matrix m) {
    Matrix t = {{
        vector(m.row[0].x, m.row[1].x, m.row[2].x), vector(m.row[0].y, m.row[1].y, m.row[2].y),
        vector(m.row[0].z, m.row[1].z, m.row[2].z),
    }};
    return t;
}

__device__ inline Vector times(Matrix m, Vector v) { return vector(dot(m.row[0], v), dot(m.row[1], v), dot(m.row[2], v)); }

__device__ inline Matrix product(Matrix a, Matrix b) {
    Matrix columns = transposed(b);
    Matrix m = {{times(columns, a.row[0]), times(columns, a.row[1]), times(columns, a.row[2])}};
    return m;
}

__device__ inline Matrix camera_rotation(const View& v) {
    Matrix m = {{load(v.pose), load(v.pose + 4), load(v.pose + 8)}};
    return m;
}

__device__ inline Vector to_camera(const View& v, Vector mean) {
    return times(camera_rotation(v), mean) + vector(v.pose[3], v.pose[7], v.pose[11]);
}

struct Axes {
    Matrix turned;  // R Q
    Vector scale;
    float w, x, y, z;  // unit quaternion
    float per_length;
};

__device__ inline Axes axes_of(const View& v, const float* quat, const float* log_scales) {
    Axes a;
    a.per_length = 1.0f / sqrtf(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
    float w = a.w = quat[0] * a.per_length;
    float x = a.x = quat[1] * a.per_length;
    float y = a.y = quat[2] * a.per_length;
    float z = a.z = quat[3] * a.per_length;
    Matrix rotation = {{
        vector(1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y)),
        vector(2.0f * (x * y + w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x)),
        vector(2.0f * (x * z - w * y), 2.0f * (y * z + w * x), 1.0f - 2.0f * (x * x + y * y)),
    }};
    a.turned = product(camera_rotation(v), rotation);
    a.scale = vector(expf(log_scales[0]), expf(log_scales[1]), expf(log_scales[2]))
        + vector(v.min_scale, v.min_scale, v.min_scale);
    return a;
}

struct Ellipse {
    Vector u, v;  // rows of J M
    float j0, j2, k1, k2;  // Jacobian: j0, j2 of its first row, and k1, k2 of its second
    float uu, uv, vv;
    Vector normal;  // u x v: its square is the determinant before dilation, without cancellation for needles
};

__device__ inline Ellipse ellipse_of(const View& v, Vector p, const Axes& a) {
    Ellipse e;
    float per_z = 1.0f / p.z;
    e.j0 = v.fx * per_z;
    e.j2 = -v.fx * clamp(p.x * per_z, v.low_x, v.high_x) * per_z;
    e.k1 = v.fy * per_z;
    e.k2 = -v.fy * clamp(p.y * per_z, v.low_y, v.high_y) * per_z;
    e.u = (e.j0 * a.turned.row[0] + e.j2 * a.turned.row[2]) * a.scale;
    e.v = (e.k1 * a.turned.row[1] + e.k2 * a.turned.row[2]) * a.scale;
    e.uu = dot(e.u, e.u);
    e.uv = dot(e.u, e.v);
    e.vv = dot(e.v, e.v);
    e.normal = cross(e.u, e.v);
    return e;
}

// Test if the ellipse alpha = ALPHA_MIN of a row intersects the rectangle of pixel centres from (x, y) on.
__device__ inline bool touches(const float* row, float x, float y, float width, float height) {
    float low_x = x - row[0], low_y = y - row[1];
    float high_x = low_x + width, high_y = low_y + height;
    bool outside_x = low_x > 0.0f || high_x < 0.0f, outside_y = low_y > 0.0f || high_y < 0.0f;
    float a = row[4], b = row[5], c = row[6];
    float reach = 2.0f * LN2 * (row[7] - LOG2_ALPHA_MIN);
    bool intersects = !outside_x && !outside_y;
    if (outside_x) {
        float dx = low_x > 0.0f ? low_x : high_x, dy = clamp(-b * dx / c, low_y, high_y);
        intersects = intersects || (a * dx + 2.0f * b * dy) * dx + c * dy * dy <= reach;
    }
    if (outside_y) {
        float dy = low_y > 0.0f ? low_y : high_y, dx = clamp(-b * dy / a, low_x, high_x);
        intersects = intersects || (a * dx + 2.0f * b * dy) * dx + c * dy * dy <= reach;
    }
    return intersects;
}

struct Range { int begin, end; };

// Return the tiles with pixel centres within reach of a point.
__device__ inline Range tiles_within(float middle, float reach, int tiles) {
    float low = floorf((middle - reach - 0.5f) / TILE), high = floorf((middle + reach - 0.5f) / TILE) + 1.0f;
    Range range = {(int)clamp(low, 0.0f, (float)tiles), (int)clamp(high, 0.0f, (float)tiles)};
    return range;
}

__device__ inline bool touches_tile(const float* row, int x, int y) {
    return touches(row, x * TILE + 0.5f, y * TILE + 0.5f, TILE - 1.0f, TILE - 1.0f);
}

// Project splats; depths of splats that are not drawn are infinite, their radii and numbers of tiles are 0.
extern "C" __global__ void project(
    View v, const float* means, const float* quats, const float* log_scales, const float* logits, const float* sh,
    const float* weights, const unsigned char* filters, float* rows, float* colors, float* radii, float* depths,
    int* counts
) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= v.count) { return; }
    float* row = rows + ROW * i;
    radii[i] = 0.0f;
    counts[i] = 0;
    depths[i] = INFINITE;
    Vector mean = load(means + 3 * i), p = to_camera(v, mean);
    float opacity = (weights ? weights[i] : 1.0f) * sigmoid(logits[i]);
    if (!(p.z > v.near) || !(opacity > ALPHA_MIN)) { return; }
    Ellipse e = ellipse_of(v, p, axes_of(v, quats + 4 * i, log_scales + 3 * i));
    bool filtered = filters && filters[i];
    float dilation = filtered ? MIP_VARIANCE : DILATION;
    float undilated = dot(e.normal, e.normal);
    float determinant = undilated + dilation * (e.uu + e.vv + dilation);
    if (filtered) {
        opacity *= sqrtf(undilated / determinant);
        if (!(opacity > ALPHA_MIN)) { return; }
    }
    float xx = e.uu + dilation, yy = e.vv + dilation;
    float x = v.fx * p.x / p.z + v.cx, y = v.fy * p.y / p.z + v.cy;
    float reach = sqrtf(2.0f * logf(opacity / ALPHA_MIN));
    float half_x = reach * sqrtf(xx), half_y = reach * sqrtf(yy);
    if (!(x + half_x > 0.0f && x - half_x < v.width && y + half_y > 0.0f && y - half_y < v.height)) { return; }
    float half_difference = 0.5f * (xx - yy);
    radii[i] = 3.0f * sqrtf(0.5f * (xx + yy) + sqrtf(half_difference * half_difference + e.uv * e.uv));
    depths[i] = p.z;

    float values[BASES];
    Vector offset = mean - load(v.position);
    basis((1.0f / sqrtf(dot(offset, offset))) * offset, v.degree, values);
    Vector color = vector(0.5f, 0.5f, 0.5f);
    for (int k = 0; k < (v.degree + 1) * (v.degree + 1); k++) {
        color = color + values[k] * load(sh + 3 * ((long long)i * v.terms + k));
    }
    int channels = (color.x > 0.0f) | (color.y > 0.0f) << 1 | (color.z > 0.0f) << 2;
    colors[3 * i] = fmaxf(color.x, 0.0f);
    colors[3 * i + 1] = fmaxf(color.y, 0.0f);
    colors[3 * i + 2] = fmaxf(color.z, 0.0f);
    row[0] = x;
    row[1] = y;
    row[2] = half_x;
    row[3] = half_y;
    row[4] = yy / determinant;
    row[5] = -e.uv / determinant;
    row[6] = xx / determinant;
    row[7] = logf(opacity) * LOG2_E;
    row[8] = p.z;
    row[9] = channels;

    int touched = 0;
    Range columns = tiles_within(x, half_x, v.across), lines = tiles_within(y, half_y, v.down);
    for (int line = lines.begin; line < lines.end; line++) {
        for (int column = columns.begin; column < columns.end; column++) { touched += touches_tile(row, column, line); }
    }
    counts[i] = touched;
}

// List the tiles of every splat, in order of depth. A compiler may compile the same test differently here and in project.
// So no more pairs are listed than were counted, and missing pairs get a tile outside the image.
template <typename Tile> __device__ inline void list_tiles(
    View v, const long long* order, const long long* ends, const float* rows, const int* counts, Tile* tiles, int* splats
) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= v.count) { return; }
    int i = (int)order[k];
    long long end = ends[k], at = end - counts[i];
    if (at == end) { return; }
    const float* row = rows + ROW * i;
    Range columns = tiles_within(row[0], row[2], v.across), lines = tiles_within(row[1], row[3], v.down);
    for (int line = lines.begin; line < lines.end; line++) {
        for (int column = columns.begin; column < columns.end; column++) {
            if (at < end && touches_tile(row, column, line)) {
                tiles[at] = (Tile)(line * v.across + column);
                splats[at++] = i;
            }
        }
    }
    for (; at < end; at++) {
        tiles[at] = (Tile)(v.across * v.down);
        splats[at] = i;
    }
}

extern "C" __global__ void list_pairs(
    View v, const long long* order, const long long* ends, const float* rows, const int* counts, short* tiles, int* splats
) {
    list_tiles(v, order, ends, rows, counts, tiles, splats);
}

// For images of more tiles than a short can count.
extern "C" __global__ void list_many_pairs(
    View v, const long long* order, const long long* ends, const float* rows, const int* counts, int* tiles, int* splats
) {
    list_tiles(v, order, ends, rows, counts, tiles, splats);
}

// Propagate the sums of blend_backward to the parameters. A block processes 64 splats.
extern "C" __global__ void project_backward(
    View v, const float* means, const float* quats, const float* log_scales, const float* logits, const float* sh,
    const float* weights, const unsigned char* filters, const float* rows, const float* radii, const float* sums,
    const float* by_colors, float* by_means, float* by_quats, float* by_log_scales, float* by_logits, float* by_sh,
    float* by_weights, float* grad2d, float* absgrad2d
) {
    __shared__ float bases[64 * BASES];
    __shared__ float shades[64 * 3];
    int lane = threadIdx.x, first = blockIdx.x * 64, i = first + lane, active = (v.degree + 1) * (v.degree + 1);
    for (int k = 0; k < active; k++) { bases[lane * BASES + k] = 0.0f; }
    for (int k = 0; k < 3; k++) { shades[lane * 3 + k] = 0.0f; }
    Vector by_mean = vector(0.0f, 0.0f, 0.0f), by_log_scale = by_mean;
    float by_quat[4] = {0.0f, 0.0f, 0.0f, 0.0f}, by_logit = 0.0f, by_weight = 0.0f;
    if (i < v.count && radii[i] > 0.0f) {
        const float* row = rows + ROW * i;
        const float* sum = sums + SUMS * i;
        Vector mean = load(means + 3 * i), p = to_camera(v, mean);
        Axes a = axes_of(v, quats + 4 * i, log_scales + 3 * i);
        Ellipse e = ellipse_of(v, p, a);

        // d sigma / d mean = -e and d sigma / d cov = -e et / 2, with e = conic d
        float by_log_opacity = -sum[0], by_x = -sum[1], by_y = -sum[2];
        float by_xx = -0.5f * sum[3], by_xy = -sum[4], by_yy = -0.5f * sum[5];
        grad2d[2 * i] = by_x * 0.5f * v.width;
        grad2d[2 * i + 1] = by_y * 0.5f * v.height;
        if (absgrad2d) {
            absgrad2d[2 * i] = sum[6] * 0.5f * v.width;
            absgrad2d[2 * i + 1] = sum[7] * 0.5f * v.height;
        }

        // xx = u.u, xy = u.v, yy = v.v
        Vector by_u = 2.0f * by_xx * e.u + by_xy * e.v, by_v = 2.0f * by_yy * e.v + by_xy * e.u;
        if (filters && filters[i]) {  // the opacity has the factor |u x v| / sqrt(det cov)
            float unit = by_log_opacity / dot(e.normal, e.normal), half_of = -0.5f * by_log_opacity;
            by_u = by_u + unit * cross(e.v, e.normal) + 2.0f * half_of * row[4] * e.u + 2.0f * half_of * row[5] * e.v;
            by_v = by_v + unit * cross(e.normal, e.u) + 2.0f * half_of * row[6] * e.v + 2.0f * half_of * row[5] * e.u;
        }
        float by_j0 = dot(by_u, a.turned.row[0] * a.scale), by_j2 = dot(by_u, a.turned.row[2] * a.scale);
        float by_k1 = dot(by_v, a.turned.row[1] * a.scale), by_k2 = dot(by_v, a.turned.row[2] * a.scale);

        // the mean affects its projection fx x/z + cx, and j0 = fx/z and j2 = -fx ratio_x/z,
        float per_z = 1.0f / p.z, ratio_x = p.x * per_z, ratio_y = p.y * per_z;
        Vector by_p = vector(by_x * e.j0, by_y * e.k1, 0.0f);
        by_p.z = -(by_p.x * p.x + by_p.y * p.y + by_j0 * e.j0 + by_j2 * e.j2 + by_k1 * e.k1 + by_k2 * e.k2) * per_z;
        // where ratio_x = x/z unless it is clamped
        float by_ratio_x = v.low_x < ratio_x && ratio_x < v.high_x ? -by_j2 * e.j0 * per_z : 0.0f;
        float by_ratio_y = v.low_y < ratio_y && ratio_y < v.high_y ? -by_k2 * e.k1 * per_z : 0.0f;
        by_p = by_p + vector(by_ratio_x, by_ratio_y, -(by_ratio_x * ratio_x + by_ratio_y * ratio_y));

        // M = R Q diag(s): d loss / d Q = Rt (d loss / d M) diag(s), and s = exp(log_scale) + min_scale
        Matrix by_m = {{e.j0 * by_u, e.k1 * by_v, e.j2 * by_u + e.k2 * by_v}};
        Vector by_scale = by_m.row[0] * a.turned.row[0] + by_m.row[1] * a.turned.row[1] + by_m.row[2] * a.turned.row[2];
        by_log_scale = by_scale * (a.scale - vector(v.min_scale, v.min_scale, v.min_scale));
        for (int k = 0; k < 3; k++) { by_m.row[k] = by_m.row[k] * a.scale; }
        Matrix to_world = transposed(camera_rotation(v)), r = product(to_world, by_m);
        float w = a.w, x = a.x, y = a.y, z = a.z;
        by_quat[0] = 2.0f * (x * (r.row[2].y - r.row[1].z) + y * (r.row[0].z - r.row[2].x) + z * (r.row[1].x - r.row[0].y));
        by_quat[1] = 2.0f * (-2.0f * x * (r.row[1].y + r.row[2].z) + y * (r.row[0].y + r.row[1].x)
            + z * (r.row[0].z + r.row[2].x) + w * (r.row[2].y - r.row[1].z));
        by_quat[2] = 2.0f * (x * (r.row[0].y + r.row[1].x) - 2.0f * y * (r.row[0].x + r.row[2].z)
            + z * (r.row[1].z + r.row[2].y) + w * (r.row[0].z - r.row[2].x));
        by_quat[3] = 2.0f * (x * (r.row[0].z + r.row[2].x) + y * (r.row[1].z + r.row[2].y)
            - 2.0f * z * (r.row[0].x + r.row[1].y) + w * (r.row[1].x - r.row[0].y));
        float along = by_quat[0] * w + by_quat[1] * x + by_quat[2] * y + by_quat[3] * z;
        by_quat[0] = (by_quat[0] - along * w) * a.per_length;
        by_quat[1] = (by_quat[1] - along * x) * a.per_length;
        by_quat[2] = (by_quat[2] - along * y) * a.per_length;
        by_quat[3] = (by_quat[3] - along * z) * a.per_length;
        by_logit = by_log_opacity * (1.0f - sigmoid(logits[i]));
        by_weight = by_log_opacity / (weights ? weights[i] : 1.0f);

        // direction = (mean - position) / length: only the perpendicular component changes it
        int channels = (int)row[9];
        Vector shade = load(by_colors + 3 * i);
        shade = vector(channels & 1 ? shade.x : 0.0f, channels & 2 ? shade.y : 0.0f, channels & 4 ? shade.z : 0.0f);
        Vector offset = mean - load(v.position);
        float per_distance = 1.0f / sqrtf(dot(offset, offset));
        Vector direction = per_distance * offset, by_direction = vector(0.0f, 0.0f, 0.0f), slopes[BASES];
        float values[BASES];
        basis(direction, v.degree, values);
        basis_gradient(direction, v.degree, slopes);
        for (int k = 0; k < active; k++) {
            bases[lane * BASES + k] = values[k];
            by_direction = by_direction + dot(load(sh + 3 * ((long long)i * v.terms + k)), shade) * slopes[k];
        }
        shades[3 * lane] = shade.x;
        shades[3 * lane + 1] = shade.y;
        shades[3 * lane + 2] = shade.z;
        by_mean = times(to_world, by_p) + per_distance * (by_direction - dot(by_direction, direction) * direction);
    }
    if (i < v.count) {
        by_means[3 * i] = by_mean.x;
        by_means[3 * i + 1] = by_mean.y;
        by_means[3 * i + 2] = by_mean.z;
        for (int k = 0; k < 4; k++) { by_quats[4 * i + k] = by_quat[k]; }
        by_log_scales[3 * i] = by_log_scale.x;
        by_log_scales[3 * i + 1] = by_log_scale.y;
        by_log_scales[3 * i + 2] = by_log_scale.z;
        by_logits[i] = by_logit;
        if (by_weights) { by_weights[i] = by_weight; }
    }
    __syncthreads();
    int width = 3 * v.terms, count = v.count - first < 64 ? v.count - first : 64;
    for (int k = lane; k < count * width; k += 64) {
        int splat = k / width, term = k % width / 3;
        float value = term < active ? bases[splat * BASES + term] * shades[splat * 3 + k % 3] : 0.0f;
        by_sh[(long long)first * width + k] = value;
    }
}

// -- blending --------------------------------------------------------------------------------------------------------

struct Fetched {
    float row[9];  // the first numbers of the projected splat
    float red, green, blue;
    int splat;
    unsigned int strips;  // bit mask of the strips that it touches
};

// Pixel of a thread.
struct Pixel {
    int warp, lane, x, y, at;
    bool inside;
    float center_x, center_y;
};

__device__ inline Pixel pixel_of(Image m) {
    Pixel p;
    p.warp = threadIdx.x / 32;
    p.lane = threadIdx.x % 32;
    p.x = blockIdx.x % m.across * TILE + p.warp % 2 * STRIP_WIDTH + p.lane % STRIP_WIDTH;
    p.y = blockIdx.x / m.across * TILE + p.warp / 2 * STRIP_HEIGHT + p.lane / STRIP_WIDTH;
    p.at = p.y * m.width + p.x;
    p.inside = p.x < m.width && p.y < m.height;
    p.center_x = p.x + 0.5f;
    p.center_y = p.y + 0.5f;
    return p;
}

// Fetch the next splats of a tile into shared memory; a thread fetches one.
__device__ inline void fetch(
    Image m, Fetched* batch, int first, int end, const int* pairs, const float* rows, const float* colors
) {
    int at = first + threadIdx.x;
    if (at < end) {
        Fetched s;
        s.splat = pairs[at];
        for (int k = 0; k < 9; k++) { s.row[k] = rows[ROW * s.splat + k]; }
        s.red = colors[3 * s.splat];
        s.green = colors[3 * s.splat + 1];
        s.blue = colors[3 * s.splat + 2];
        s.strips = 0;
        for (int strip = 0; strip < STRIPS; strip++) {
            float x = blockIdx.x % m.across * TILE + strip % 2 * STRIP_WIDTH + 0.5f;
            float y = blockIdx.x / m.across * TILE + strip / 2 * STRIP_HEIGHT + 0.5f;
            s.strips |= (unsigned int)touches(s.row, x, y, STRIP_WIDTH - 1.0f, STRIP_HEIGHT - 1.0f) << strip;
        }
        batch[threadIdx.x] = s;
    }
    __syncthreads();
}

// Return a bit mask of the 32 fetched splats from `first` on that touch a pixel's strip.
__device__ inline unsigned int touching(const Fetched* batch, int first, int count, Pixel p) {
    int k = first + p.lane;
    return __ballot_sync(ALL, k < count && (batch[k].strips >> p.warp & 1));
}

struct Alpha { float e_x, e_y, uncapped, alpha; };  // e = conic (pixel - mean)

__device__ inline Alpha alpha_of(const Fetched& s, Pixel p) {
    Alpha a;
    float dx = p.center_x - s.row[0], dy = p.center_y - s.row[1];
    a.e_x = s.row[4] * dx + s.row[5] * dy;
    a.e_y = s.row[5] * dx + s.row[6] * dy;
    float log2_alpha = s.row[7] - 0.5f * LOG2_E * (dx * a.e_x + dy * a.e_y);
    a.uncapped = exp2f(log2_alpha);
    a.alpha = log2_alpha >= LOG2_ALPHA_MIN ? fminf(a.uncapped, ALPHA_MAX) : 0.0f;
    return a;
}

// Blend front to back. T becomes negative when a pixel is finished, and is negative outside the image; |T| is preserved.
extern "C" __global__ void blend(
    Image m, const int* starts, const int* pairs, const float* rows, const float* colors, const float* limit,
    float* image, float* light, int* reached, int* median
) {
    __shared__ Fetched batch[THREADS];
    Pixel p = pixel_of(m);
    int begin = starts[blockIdx.x], end = starts[blockIdx.x + 1], used = begin, middle = -1;
    float t = p.inside ? 1.0f : -1.0f, red = 0.0f, green = 0.0f, blue = 0.0f;
    float furthest = limit && p.inside ? limit[p.at] : INFINITE;
    for (int first = begin; first < end; first += THREADS) {
        if (__syncthreads_and(t <= 0.0f)) { break; }
        fetch(m, batch, first, end, pairs, rows, colors);
        int count = end - first < THREADS ? end - first : THREADS;
        for (int group = 0; group < count; group += 32) {
            if (__all_sync(ALL, t <= 0.0f)) { break; }
            unsigned int remaining = touching(batch, group, count, p);
            used = first + (group + 32 < count ? group + 32 : count);
            while (remaining) {
                const Fetched& s = batch[group + __ffs(remaining) - 1];
                remaining &= remaining - 1;
                if (t <= 0.0f) { continue; }
                float alpha = alpha_of(s, p).alpha, next = t - alpha * t;
                if (!(next > TRANSMITTANCE_MIN) || s.row[8] > furthest) {
                    t = -t;
                    continue;
                }
                float w = alpha * t;
                red += w * s.red;
                green += w * s.green;
                blue += w * s.blue;
                if (t > 0.5f && next <= 0.5f) { middle = s.splat; }
                t = next;
            }
        }
    }
    if (p.lane == 0) { reached[STRIPS * blockIdx.x + p.warp] = used; }
    if (!p.inside) { return; }
    t = fabsf(t);
    image[3 * p.at] = red + t * m.red;
    image[3 * p.at + 1] = green + t * m.green;
    image[3 * p.at + 2] = blue + t * m.blue;
    light[p.at] = t;
    if (median) { median[p.at] = middle; }
}

// Sum 16 values over a warp; return the sum of value lane / 2.
__device__ inline float sum_values(float* values, int lane) {
#pragma unroll
    for (int half = 8; half > 0; half /= 2) {
        bool upper = lane & 2 * half;
#pragma unroll
        for (int k = 0; k < half; k++) {
            float sent = upper ? values[k] : values[k + half], kept = upper ? values[k + half] : values[k];
            values[k] = kept + __shfl_xor_sync(ALL, sent, 2 * half);
        }
    }
    return values[0] + __shfl_xor_sync(ALL, values[0], 1);
}

// Add each splat's share to its sums. With h = d loss / d colour and Q the part of the loss's derivative behind a splat,
// g = d loss / d sigma = alpha Q / (1 - alpha) - w (c.h), see gpu/shaders/blend.wgsl.
extern "C" __global__ void blend_backward(
    Image m, const int* starts, const int* pairs, const float* rows, const float* colors, const int* reached,
    const float* image, const float* light, const float* by_image, const float* by_alpha, float* sums,
    float* by_colors, int absolute
) {
    __shared__ Fetched batch[THREADS];
    Pixel p = pixel_of(m);
    int begin = starts[blockIdx.x], used = reached[STRIPS * blockIdx.x + p.warp], end = begin;
    for (int strip = 0; strip < STRIPS; strip++) {
        int other = reached[STRIPS * blockIdx.x + strip];
        end = other > end ? other : end;
    }
    float t = p.inside ? 1.0f : -1.0f, q = 0.0f;
    Vector h = vector(0.0f, 0.0f, 0.0f);
    if (p.inside) {
        if (by_image) { h = load(by_image + 3 * p.at); }
        q = dot(load(image + 3 * p.at), h);
        if (by_alpha) { q -= light[p.at] * by_alpha[p.at]; }
    }
    for (int first = begin; first < end; first += THREADS) {
        __syncthreads();
        fetch(m, batch, first, end, pairs, rows, colors);
        int count = end - first < THREADS ? end - first : THREADS;
        for (int group = 0; group < count && first + group < used; group += 32) {
            unsigned int remaining = touching(batch, group, count, p);
            while (remaining) {
                const Fetched& s = batch[group + __ffs(remaining) - 1];
                remaining &= remaining - 1;
                Alpha a = alpha_of(s, p);
                float next = t - a.alpha * t;
                bool takes = next > TRANSMITTANCE_MIN;
                float w = takes ? a.alpha * t : 0.0f;
                t = takes ? next : -fabsf(t);
                if (!__any_sync(ALL, w > 0.0f)) { continue; }
                float received = w * (s.red * h.x + s.green * h.y + s.blue * h.z);
                q -= received;
                float g = w > 0.0f && a.uncapped < ALPHA_MAX ? a.alpha * q / (1.0f - a.alpha) - received : 0.0f;
                float g_x = g * a.e_x, g_y = g * a.e_y;
                float values[16] = {
                    g, g_x, g_y, g_x * a.e_x, g_x * a.e_y, g_y * a.e_y, fabsf(g_x), fabsf(g_y), w * h.x, w * h.y, w * h.z,
                };
                float sum = sum_values(values, p.lane);
                int column = p.lane / 2;
                if (p.lane % 2 == 0 && column < SUMS && (absolute || column < 6)) {
                    atomicAdd(sums + SUMS * s.splat + column, sum);
                } else if (p.lane % 2 == 0 && column >= SUMS && column < GRADIENTS) {
                    atomicAdd(by_colors + 3 * s.splat + column - SUMS, sum);
                }
            }
        }
    }
}

// Measure each splat's largest weight (as the bits of a positive float), sum of weights, and number of pixels.
extern "C" __global__ void weigh(
    Image m, const int* starts, const int* pairs, const float* rows, const float* colors, int* largest, float* total,
    int* pixels
) {
    __shared__ Fetched batch[THREADS];
    Pixel p = pixel_of(m);
    int begin = starts[blockIdx.x], end = starts[blockIdx.x + 1];
    float t = p.inside ? 1.0f : -1.0f;
    for (int first = begin; first < end; first += THREADS) {
        if (__syncthreads_and(t <= 0.0f)) { break; }
        fetch(m, batch, first, end, pairs, rows, colors);
        int count = end - first < THREADS ? end - first : THREADS;
        for (int group = 0; group < count; group += 32) {
            unsigned int remaining = touching(batch, group, count, p);
            while (remaining) {
                const Fetched& s = batch[group + __ffs(remaining) - 1];
                remaining &= remaining - 1;
                float alpha = alpha_of(s, p).alpha, next = t - alpha * t;
                bool takes = next > TRANSMITTANCE_MIN;
                float w = takes ? alpha * t : 0.0f, highest = w;
                t = takes ? next : -fabsf(t);
                unsigned int weighted = __ballot_sync(ALL, w > 0.0f);
                if (!weighted) { continue; }
                for (int distance = 16; distance > 0; distance /= 2) {
                    w += __shfl_xor_sync(ALL, w, distance);
                    highest = fmaxf(highest, __shfl_xor_sync(ALL, highest, distance));
                }
                if (p.lane == 0) {
                    atomicMax(largest + s.splat, __float_as_int(highest));
                    atomicAdd(total + s.splat, w);
                    atomicAdd(pixels + s.splat, __popc(weighted));
                }
            }
        }
    }
}

// -- loss ------------------------------------------------------------------------------------------------------------

#define REACH 5  // of SSIM's window
#define SIDE (TILE + 2 * REACH)
#define C1 0.0001f
#define C2 0.0009f

__device__ inline float window(int k) {
    float distance = (float)(k - REACH);
    return WINDOW_MIDDLE * expf(distance * distance / -4.5f);
}

// Return the pixel k of a tile with its border, or -1 outside the image.
__device__ inline int border_pixel(Image m, int k) {
    int x = blockIdx.x % m.across * TILE + k % SIDE - REACH, y = blockIdx.x / m.across * TILE + k / SIDE - REACH;
    return x >= 0 && x < m.width && y >= 0 && y < m.height ? y * m.width + x : -1;
}

// Write the derivatives of SSIM by the windowed x, x^2 and xy of each channel, and add up L1 and SSIM.
extern "C" __global__ void compare(Image m, const float* image, const float* photo, float* slopes, double* sums) {
    __shared__ float pixels[2][SIDE * SIDE];
    __shared__ float lines[4][SIDE * TILE];
    int column = threadIdx.x % TILE, line = threadIdx.x / TILE, middle = (line + REACH) * SIDE + column + REACH;
    int at = border_pixel(m, middle), count = m.width * m.height;
    float l1 = 0.0f, ssim = 0.0f;
    for (int channel = 0; channel < 3; channel++) {
        for (int k = threadIdx.x; k < SIDE * SIDE; k += THREADS) {
            int pixel = border_pixel(m, k);
            pixels[0][k] = pixel < 0 ? 0.0f : image[3 * pixel + channel];
            pixels[1][k] = pixel < 0 ? 0.0f : photo[3 * pixel + channel];
        }
        __syncthreads();
        for (int k = threadIdx.x; k < SIDE * TILE; k += THREADS) {
            int first = k / TILE * SIDE + k % TILE;
            float mx = 0.0f, my = 0.0f, squares = 0.0f, products = 0.0f;
#pragma unroll
            for (int d = 0; d <= 2 * REACH; d++) {
                float x = pixels[0][first + d], y = pixels[1][first + d];
                mx += window(d) * x;
                my += window(d) * y;
                squares += window(d) * (x * x + y * y);
                products += window(d) * x * y;
            }
            lines[0][k] = mx;
            lines[1][k] = my;
            lines[2][k] = squares;
            lines[3][k] = products;
        }
        __syncthreads();
        if (at >= 0) {
            float mean[4] = {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll
            for (int d = 0; d <= 2 * REACH; d++) {
                for (int k = 0; k < 4; k++) { mean[k] += window(d) * lines[k][(line + d) * TILE + column]; }
            }
            float mx = mean[0], my = mean[1];
            float n1 = 2.0f * mx * my + C1, n2 = 2.0f * (mean[3] - mx * my) + C2;
            float d1 = mx * mx + my * my + C1, d2 = mean[2] - mx * mx - my * my + C2;
            float value = n1 * n2 / (d1 * d2), by_xx = -value / d2, by_xy = 2.0f * n1 / (d1 * d2);
            float* slope = slopes + 3 * channel * count + at;
            slope[0] = 2.0f * my * n2 / (d1 * d2) - 2.0f * mx * value / d1 - 2.0f * mx * by_xx - my * by_xy;
            slope[count] = by_xx;
            slope[2 * count] = by_xy;
            l1 += fabsf(pixels[0][middle] - pixels[1][middle]);
            ssim += value;
        }
        __syncthreads();
    }
    for (int distance = 16; distance > 0; distance /= 2) {
        l1 += __shfl_xor_sync(ALL, l1, distance);
        ssim += __shfl_xor_sync(ALL, ssim, distance);
    }
    if (threadIdx.x % 32 == 0) {
        atomicAdd(sums, (double)l1);
        atomicAdd(sums + 1, (double)ssim);
    }
}

// Compute the gradient: the derivatives by the means propagate to a value as their windowed mean.
extern "C" __global__ void compare_backward(
    Image m, const float* image, const float* photo, const float* slopes, const float* by_loss, float ssim_weight,
    float* by_image
) {
    __shared__ float pixels[3][SIDE * SIDE];
    __shared__ float lines[3][SIDE * TILE];
    int column = threadIdx.x % TILE, line = threadIdx.x / TILE;
    int at = border_pixel(m, (line + REACH) * SIDE + column + REACH), count = m.width * m.height;
    float unit = by_loss[0] / (3.0f * count);
    for (int channel = 0; channel < 3; channel++) {
        for (int k = threadIdx.x; k < SIDE * SIDE; k += THREADS) {
            int pixel = border_pixel(m, k);
            for (int n = 0; n < 3; n++) {
                pixels[n][k] = pixel < 0 ? 0.0f : slopes[(3 * channel + n) * count + pixel];
            }
        }
        __syncthreads();
        for (int k = threadIdx.x; k < SIDE * TILE; k += THREADS) {
            for (int n = 0; n < 3; n++) {
                float sum = 0.0f;
#pragma unroll
                for (int d = 0; d <= 2 * REACH; d++) { sum += window(d) * pixels[n][k / TILE * SIDE + k % TILE + d]; }
                lines[n][k] = sum;
            }
        }
        __syncthreads();
        if (at >= 0) {
            float mean[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll
            for (int d = 0; d <= 2 * REACH; d++) {
                for (int n = 0; n < 3; n++) { mean[n] += window(d) * lines[n][(line + d) * TILE + column]; }
            }
            float x = image[3 * at + channel], y = photo[3 * at + channel];
            float through_l1 = (float)(x > y) - (float)(x < y), through_ssim = mean[0] + 2.0f * x * mean[1] + y * mean[2];
            by_image[3 * at + channel] = unit * ((1.0f - ssim_weight) * through_l1 - ssim_weight * through_ssim);
        }
        __syncthreads();
    }
}

// -- Adam ------------------------------------------------------------------------------------------------------------

// Make an Adam step (Kingma and Ba 2015, Algorithm 1). Number i of the tensor has the rate rates[i % width], or rate.
// Rows of row_width numbers change where trained is true; without it, all do.
extern "C" __global__ void adam(
    float* values, const float* gradient, float* m, float* v, const float* rates, float rate, int width, long long count,
    const bool* trained, int row_width, float keep_m, float keep_v, float first, float second, float eps
) {
    long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= count || (trained && !trained[i / row_width])) { return; }
    float g = gradient[i];
    float moment = keep_m * m[i] + (1.0f - keep_m) * g, square = keep_v * v[i] + (1.0f - keep_v) * (g * g);
    moment = fabsf(moment) > 1e-30f ? moment : 0.0f;  // smaller moments are set to zero, as on the CPU
    square = square > 1e-36f ? square : 0.0f;
    m[i] = moment;
    v[i] = square;
    float own_rate = rates ? rates[i % width] : rate;
    values[i] -= own_rate / first * moment / (sqrtf(square / second) + eps);
}
