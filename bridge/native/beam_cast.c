#include "bridge/native/beam_cast.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

#define HALF_TURN 3.141592653589793
#define NO_ECHO   (-1.0)

/* A displacement is bounded by that of the ends of the scan; the path between them bends by less than this. */
#define BEND 1.1

/* Added to bounds that would be exact but for rounding, m. */
#define ROUNDING_M 1e-9

/* Sine up to which an angle is bounded by the sine times BEND. */
#define SMALL_SINE 0.7

static double dot(const double one[3], const double other[3])
{
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2];
}

static double length(const double vector[3])
{
    return sqrt(dot(vector, vector));
}

/* Not fmin and fmax, which are calls for the sake of NaN. */
static double least(double one, double other)
{
    return one < other ? one : other;
}

static double greatest(double one, double other)
{
    return one > other ? one : other;
}

static void minus(const double one[3], const double other[3], double result[3])
{
    for (unsigned i = 0U; i < 3U; i++) {
        result[i] = one[i] - other[i];
    }
}

void beam_pattern_init(beam_pattern *self, const double *elevation)
{
    for (uint32_t i = 0U; i < self->columns; i++) {
        const double angle = self->azimuth_first + (double)i * self->azimuth_step;
        self->azimuth[i][0] = cos(angle);
        self->azimuth[i][1] = sin(angle);
    }
    for (uint32_t i = 0U; i < self->lines; i++) {
        self->elevation[i][0] = cos(elevation[i]);
        self->elevation[i][1] = sin(elevation[i]);
        self->slope[i] = self->elevation[i][1] / self->elevation[i][0];
    }
    const double span = self->slope[self->lines - 1U] - self->slope[0];
    self->bucket_per_slope = span > 0.0 ? (double)BEAM_BUCKETS / span : 0.0;
    uint32_t line = 0U;
    for (uint32_t i = 0U; i <= BEAM_BUCKETS; i++) {
        const double edge = self->slope[0] + (double)i / (double)BEAM_BUCKETS * span;
        while (line < self->lines && self->slope[line] < edge) {
            line++;
        }
        /* One less: the edge of a bucket and the bucket of an edge round differently. */
        self->bucket[i] = line > 0U ? line - 1U : 0U;
    }
}

/* Lines whose slope is below one; a slope that two quads share parts the lines between them. */
static uint32_t lines_below(const beam_pattern *pattern, double slope)
{
    if (!(slope > pattern->slope[0])) {
        return 0U;
    }
    if (slope > pattern->slope[pattern->lines - 1U]) {
        return pattern->lines;
    }
    uint32_t line = pattern->bucket[(uint32_t)((slope - pattern->slope[0]) * pattern->bucket_per_slope)];
    while (pattern->slope[line] < slope) { /* not beyond the last, which is not below */
        line++;
    }
    return line;
}

/* Unit normal of a triangle between corners of a quad, zero where it has no area. */
static void triangle_normal(const beam_quad *quad, unsigned a, unsigned b, unsigned c, double normal[3])
{
    double one[3];
    double other[3];
    for (unsigned axis = 0U; axis < 3U; axis++) {
        one[axis] = quad->corner[axis][b] - quad->corner[axis][a];
        other[axis] = quad->corner[axis][c] - quad->corner[axis][a];
    }
    for (unsigned axis = 0U; axis < 3U; axis++) {
        const unsigned next = (axis + 1U) % 3U;
        const unsigned last = (axis + 2U) % 3U;
        normal[axis] = one[next] * other[last] - one[last] * other[next];
    }
    const double area = length(normal);
    for (unsigned axis = 0U; axis < 3U; axis++) {
        normal[axis] = area > 0.0 ? normal[axis] / area : 0.0;
    }
}

/* How far along a normal a corner is, m from the frame's origin. */
static double height_of(const beam_quad *quad, const double normal[3], unsigned corner)
{
    return normal[0] * quad->corner[0][corner] + normal[1] * quad->corner[1][corner] +
           normal[2] * quad->corner[2][corner];
}

void beam_quad_init(beam_quad *self)
{
    triangle_normal(self, 0U, 1U, 2U, self->normal[0]);
    triangle_normal(self, 0U, 2U, 3U, self->normal[1]);
    self->offset[0] = height_of(self, self->normal[0], 0U);
    self->offset[1] = height_of(self, self->normal[1], 0U);
    /* Convex: each diagonal has the other two corners on both sides. */
    double other[2][3];
    triangle_normal(self, 1U, 2U, 3U, other[0]);
    triangle_normal(self, 1U, 3U, 0U, other[1]);
    const bool convex = dot(self->normal[0], self->normal[1]) > 0.0 && dot(other[0], other[1]) > 0.0;
    self->folded = !convex || fabs(height_of(self, self->normal[0], 3U) - self->offset[0]) > BEAM_QUAD_FLAT_M;
    for (unsigned axis = 0U; axis < 3U; axis++) {
        const double *value = self->corner[axis];
        self->centre[axis] = 0.25 * (value[0] + value[1] + value[2] + value[3]);
    }
    self->radius = 0.0;
    for (unsigned k = 0U; k < 4U; k++) {
        const double away[3] = {self->corner[0][k] - self->centre[0], self->corner[1][k] - self->centre[1],
                                self->corner[2][k] - self->centre[2]};
        self->radius = greatest(self->radius, length(away));
    }
}

void beam_hits_clear(const beam_pattern *pattern, beam_hits *hits)
{
    for (uint32_t i = 0U; i < pattern->columns * pattern->lines; i++) {
        hits->range[i] = pattern->range_max;
        hits->echo[i] = NO_ECHO;
    }
}

/* What the casting of one body keeps at hand. */
typedef struct cast {
    const beam_pattern *pattern;
    beam_column *columns;
    beam_hits *hits;
    rigid_pose middle; /* of the LiDAR in the body's frame, in the middle of the scan */
    double path;       /* m, that it is from there at most */
    double climb;      /* m, along its upward axis, that it is from there at most */
    double turn;       /* rad, by which it is turned from there at most */
    double tilt;       /* rad, by which its upward axis is */
} cast;

/* Columns from `first` up to but not including `end`. */
typedef struct column_range {
    uint32_t first;
    uint32_t end;
} column_range;

static rigid_pose seen_from(const rigid_pose *mount, const rigid_motion *vehicle, const rigid_motion *body, double time)
{
    const rigid_pose car = rigid_motion_at(vehicle, time);
    const rigid_pose lidar = rigid_pose_out(&car, mount);
    const rigid_pose other = rigid_motion_at(body, time);
    return rigid_pose_in(&other, &lidar);
}

/* An axis of a pose or, for a place, its component along it. */
static double along(const rigid_pose *pose, unsigned axis, const double vector[3])
{
    return pose->axes[axis] * vector[0] + pose->axes[3U + axis] * vector[1] + pose->axes[6U + axis] * vector[2];
}

/* Columns between two azimuths, none of which is more than a turn and a half from 0. */
static column_range columns_between(const beam_pattern *pattern, double low, double high)
{
    const double middle = 0.5 * (low + high);
    const double shift = 2.0 * HALF_TURN * floor(middle / (2.0 * HALF_TURN) + 0.5);
    const double first = ceil((low - shift - pattern->azimuth_first) / pattern->azimuth_step);
    const double last = floor((high - shift - pattern->azimuth_first) / pattern->azimuth_step);
    const double count = (double)pattern->columns;
    column_range range = {0U, 0U};
    if (last >= 0.0 && first < count && last >= first) {
        range.first = first > 0.0 ? (uint32_t)first : 0U;
        range.end = last < count - 1.0 ? (uint32_t)last + 1U : pattern->columns;
    }
    return range;
}

/* Columns that can meet something in a sphere. */
static column_range columns_of_sphere(const cast *self, const double centre[3], double radius)
{
    const column_range all = {0U, self->pattern->columns};
    const column_range none = {0U, 0U};
    double away[3];
    minus(centre, self->middle.place, away);
    const double distance = length(away);
    if (distance - radius - self->path > self->pattern->range_max) {
        return none;
    }
    const double x = along(&self->middle, 0U, away);
    const double y = along(&self->middle, 1U, away);
    const double reach = radius + self->path + self->turn * distance;
    if (x < -reach) {
        return none;
    }
    const double level = sqrt(x * x + y * y);
    if (reach > SMALL_SINE * level) {
        return all;
    }
    const double azimuth = atan2(y, x);
    const double half = BEND * reach / level;
    return columns_between(self->pattern, azimuth - half, azimuth + half);
}

/* Corners of a quad in the axes of the LiDAR in the middle of the scan. */
typedef struct outline {
    double x[4];
    double y[4];
    double up[2];    /* m, of the lowest and of the highest */
    double level[2]; /* m from the upward axis, of the nearest and of the farthest */
    double middle;   /* m from the upward axis, of the middle */
    double distance; /* m, of the middle */
} outline;

static outline outline_of(const cast *self, const beam_quad *quad, const double centre[3])
{
    outline seen = {.up = {INFINITY, -INFINITY}, .level = {INFINITY, 0.0}, .distance = length(centre)};
    for (unsigned k = 0U; k < 4U; k++) {
        const double away[3] = {quad->corner[0][k] - self->middle.place[0], quad->corner[1][k] - self->middle.place[1],
                                quad->corner[2][k] - self->middle.place[2]};
        seen.x[k] = along(&self->middle, 0U, away);
        seen.y[k] = along(&self->middle, 1U, away);
        const double up = along(&self->middle, 2U, away);
        const double level = seen.x[k] * seen.x[k] + seen.y[k] * seen.y[k];
        seen.up[0] = least(seen.up[0], up);
        seen.up[1] = greatest(seen.up[1], up);
        seen.level[0] = least(seen.level[0], level);
        seen.level[1] = greatest(seen.level[1], level);
    }
    seen.level[0] = sqrt(seen.level[0]);
    seen.level[1] = sqrt(seen.level[1]);
    const double x = along(&self->middle, 0U, centre);
    const double y = along(&self->middle, 1U, centre);
    seen.middle = sqrt(x * x + y * y);
    return seen;
}

/* Whether a quad lies between two lines of beams during all of the scan, as most do that are far off. */
static bool lies_between_lines(const cast *self, const beam_quad *quad, const outline *seen, double slack)
{
    const double nearest = seen->middle - quad->radius - slack; /* a side may be nearer than its ends */
    if (nearest <= 0.0) {
        return false;
    }
    const double rise = self->climb + self->tilt * (seen->distance + quad->radius + self->path) + ROUNDING_M;
    const double farthest = seen->level[1] + slack;
    const double low = seen->up[0] - rise;
    const double high = seen->up[1] + rise;
    return lines_below(self->pattern, low / (low < 0.0 ? nearest : farthest)) ==
           lines_below(self->pattern, high / (high > 0.0 ? nearest : farthest));
}

/* Columns that can meet a quad. At every time the azimuths of what it covers lie between those of its corners, and
 * those differ from the ones in the middle of the scan by less than the path that the LiDAR takes shows. */
static column_range columns_of_quad(const cast *self, const beam_quad *quad)
{
    const column_range all = {0U, self->pattern->columns};
    const column_range none = {0U, 0U};
    double centre[3];
    minus(quad->centre, self->middle.place, centre);
    const double reach = self->pattern->range_max + quad->radius + self->path;
    if (dot(centre, centre) > reach * reach) {
        return none;
    }
    const outline seen = outline_of(self, quad, centre);
    const double slack = self->path + self->turn * (seen.distance + quad->radius);
    bool behind = true;
    for (unsigned k = 0U; k < 4U; k++) {
        behind = behind && seen.x[k] < -slack;
    }
    if (behind || lies_between_lines(self, quad, &seen, slack)) {
        return none;
    }
    if (slack > SMALL_SINE * seen.level[0]) {
        return all;
    }
    const double *x = seen.x;
    const double *y = seen.y;
    const double first = atan2(y[0], x[0]);
    double low = 0.0;
    double high = 0.0;
    for (unsigned k = 1U; k < 4U; k++) {
        const double turned = atan2(y[k] * x[0] - x[k] * y[0], x[k] * x[0] + y[k] * y[0]);
        low = least(low, turned);
        high = greatest(high, turned);
    }
    const double half = BEND * slack / seen.level[0];
    if (high - low + 2.0 * half >= HALF_TURN) { /* it may lie above or below the LiDAR */
        return all;
    }
    return columns_between(self->pattern, first + low - half, first + high + half);
}

/* The corners of a quad as a column sees them, m: how far left of its plane, and where in it. */
typedef struct column_view {
    double side[4];
    double ahead[4];
    double up[4];
} column_view;

/* Where an edge meets the plane of a column, m times `scale`: the direction to it needs no division. */
typedef struct crossing {
    double ahead;
    double up;
    double scale; /* above 0 */
} crossing;

/* Cross an edge from a corner left of the plane, or on it, to one right of it. Both quads at an edge get the same. */
static crossing cross(const column_view *seen, unsigned left, unsigned right)
{
    const double near = seen->side[left];
    const double far = seen->side[right];
    const crossing result = {near * seen->ahead[right] - far * seen->ahead[left],
                             near * seen->up[right] - far * seen->up[left], near - far};
    return result;
}

/* Bring the end of a line that is not ahead to where it is. */
static void clip(crossing *end, const crossing *other, double ahead)
{
    const double from = end->ahead / end->scale;
    const double to = other->ahead / other->scale;
    const double rise = end->up / end->scale;
    end->up = rise + (ahead - from) / (to - from) * (other->up / other->scale - rise);
    end->ahead = ahead;
    end->scale = 1.0;
}

/* Whether something that is ahead lies above so many lines, and not above the next. */
static bool is_between(const beam_pattern *pattern, uint32_t below, const crossing *seen)
{
    return (below == 0U || pattern->slope[below - 1U] * seen->ahead < seen->up) &&
           (below == pattern->lines || pattern->slope[below] * seen->ahead >= seen->up);
}

/* Meet the beams of a column with the line that a triangle leaves in its plane.
 * below: lines below its upper end in the column before; out: in this one. */
static void meet(const cast *self, const beam_quad *quad, unsigned triangle, uint32_t column, crossing one,
                 crossing other, uint32_t *below)
{
    const beam_pattern *pattern = self->pattern;
    const double ahead = pattern->range_min * 0.1; /* beams rise and fall by less than 80 degrees */
    const bool one_ahead = one.ahead >= ahead * one.scale;
    const bool other_ahead = other.ahead >= ahead * other.scale;
    if (!one_ahead && !other_ahead) {
        return;
    }
    if (!one_ahead) {
        clip(&one, &other, ahead);
    } else if (!other_ahead) {
        clip(&other, &one, ahead);
    }
    if (is_between(pattern, *below, &one) && is_between(pattern, *below, &other)) {
        return; /* as most that is far off, and as in the column before */
    }
    uint32_t first = lines_below(pattern, one.up / one.ahead);
    uint32_t end = lines_below(pattern, other.up / other.ahead);
    if (first > end) {
        const uint32_t low = end;
        end = first;
        first = low;
    }
    *below = end;
    const beam_column *from = &self->columns[column];
    const double *normal = quad->normal[triangle];
    const double away = quad->offset[triangle] - dot(normal, from->origin);
    const double level = dot(normal, from->ahead);
    const double rise = dot(normal, from->up);
    double *range = &self->hits->range[(size_t)column * pattern->lines];
    double *echo = &self->hits->echo[(size_t)column * pattern->lines];
    for (uint32_t line = first; line < end; line++) {
        const double sine = level * pattern->elevation[line][0] + rise * pattern->elevation[line][1];
        const double distance = away / sine; /* not finite along the surface, and so no echo */
        if (distance >= pattern->range_min && distance < range[line]) {
            range[line] = distance;
            echo[line] = quad->reflectivity * fabs(sine);
        }
    }
}

/* Cut what lies between some corners of a quad, in order around: the whole of it, or a triangle. */
static void cut(const cast *self, const beam_quad *quad, unsigned triangle, const uint8_t *corner, unsigned corners,
                uint32_t column, const column_view *seen, uint32_t *below)
{
    crossing ends[4];
    unsigned count = 0U;
    for (unsigned k = 0U; k < corners; k++) {
        const unsigned one = corner[k];
        const unsigned other = corner[k + 1U < corners ? k + 1U : 0U];
        const bool left = seen->side[one] >= 0.0;
        if (left != (seen->side[other] >= 0.0)) {
            ends[count++] = left ? cross(seen, one, other) : cross(seen, other, one);
        }
    }
    if (count == 2U) { /* 4 of a quad that is all but in the plane */
        meet(self, quad, triangle, column, ends[0], ends[1], below);
    }
}

static void cast_quad(const cast *self, const beam_quad *quad, column_range range)
{
    static const uint8_t around[4] = {0U, 1U, 2U, 3U};
    static const uint8_t first_triangle[3] = {0U, 1U, 2U};
    static const uint8_t second_triangle[3] = {0U, 2U, 3U};
    uint32_t below[2] = {0U, 0U};
    for (uint32_t column = range.first; column < range.end; column++) {
        const beam_column *from = &self->columns[column];
        column_view seen;
        double low = INFINITY;
        double high = -INFINITY;
        for (unsigned k = 0U; k < 4U; k++) {
            seen.side[k] = from->left[0] * quad->corner[0][k] + from->left[1] * quad->corner[1][k] +
                           from->left[2] * quad->corner[2][k] - from->beside;
            low = least(low, seen.side[k]);
            high = greatest(high, seen.side[k]);
        }
        if (low >= 0.0 || high < 0.0) {
            continue;
        }
        for (unsigned k = 0U; k < 4U; k++) {
            const double x = quad->corner[0][k] - from->origin[0];
            const double y = quad->corner[1][k] - from->origin[1];
            const double z = quad->corner[2][k] - from->origin[2];
            seen.ahead[k] = from->ahead[0] * x + from->ahead[1] * y + from->ahead[2] * z;
            seen.up[k] = from->up[0] * x + from->up[1] * y + from->up[2] * z;
        }
        if (quad->folded) {
            cut(self, quad, 0U, first_triangle, 3U, column, &seen, &below[0]);
            cut(self, quad, 1U, second_triangle, 3U, column, &seen, &below[1]);
        } else {
            cut(self, quad, 0U, around, 4U, column, &seen, &below[0]);
        }
    }
}

/* When a column is taken, s. */
static double column_time(const beam_pattern *pattern, uint32_t column)
{
    return -pattern->period * ((double)(pattern->columns - column) - 0.5) / (double)pattern->columns;
}

static void place_column(const cast *self, const rigid_pose *lidar, uint32_t column)
{
    const double *azimuth = self->pattern->azimuth[column];
    beam_column *to = &self->columns[column];
    for (unsigned axis = 0U; axis < 3U; axis++) {
        const double *row = &lidar->axes[3U * axis];
        to->origin[axis] = lidar->place[axis];
        to->ahead[axis] = row[0] * azimuth[0] + row[1] * azimuth[1];
        to->left[axis] = row[1] * azimuth[0] - row[0] * azimuth[1];
        to->up[axis] = row[2];
    }
    to->beside = dot(to->left, to->origin);
}

void beam_cast(const beam_pattern *pattern, const rigid_pose *mount, const rigid_motion *vehicle,
               const rigid_motion *body, const beam_quad *quads, uint32_t count, const double *centre, double radius,
               beam_column *room, beam_hits *hits)
{
    cast self = {.pattern = pattern, .columns = room, .hits = hits};
    self.middle = seen_from(mount, vehicle, body, -0.5 * pattern->period);
    const double half = 0.5 * pattern->period;
    self.turn = BEND * half * (length(vehicle->rate) + length(body->rate));
    for (unsigned end = 0U; end < 2U; end++) {
        const rigid_pose there = seen_from(mount, vehicle, body, end == 0U ? -pattern->period : 0.0);
        double away[3];
        minus(there.place, self.middle.place, away);
        self.path = greatest(self.path, BEND * length(away));
        self.climb = greatest(self.climb, BEND * fabs(along(&self.middle, 2U, away)));
        double tilted = 0.0; /* squared, of the chord between the upward axes */
        for (unsigned axis = 0U; axis < 3U; axis++) {
            const double apart = there.axes[3U * axis + 2U] - self.middle.axes[3U * axis + 2U];
            tilted += apart * apart;
        }
        self.tilt = greatest(self.tilt, BEND * sqrt(tilted));
    }
    const column_range seen = columns_of_sphere(&self, centre, radius);
    for (uint32_t column = seen.first; column < seen.end; column++) {
        const rigid_pose lidar = seen_from(mount, vehicle, body, column_time(pattern, column));
        place_column(&self, &lidar, column);
    }
    for (uint32_t i = 0U; seen.first < seen.end && i < count; i++) {
        column_range range = columns_of_quad(&self, &quads[i]);
        range.first = range.first > seen.first ? range.first : seen.first;
        range.end = range.end < seen.end ? range.end : seen.end;
        cast_quad(&self, &quads[i], range);
    }
}
